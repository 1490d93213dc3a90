"""The image of a circle: where a round dot's image lies when its centre's image is known.

A camera does not carry the centre of a circle to the middle of the circle's image. Through a pinhole the
image is a conic, and its centre has a closed form; through a lens with distortion the boundary is carried
over point by point and the centroid of the area inside is taken. Both are exact; the difference to the
centre's own image is what a measurement of dots must be corrected by.

Sources: Heikkilä 2000, "Geometric camera calibration using circular control points", section 3 (conic);
Song et al. 2024, arXiv 2403.04583 (centroid of the distorted area).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from calib.camera.cahvor import CameraModel
from calib.rigid import FloatArray, Rigid
from calib.survey import Board

BOUNDARY_POINTS = 32


def conic_centres(pixel_from_plane: ArrayLike, centres: ArrayLike, radius: float) -> FloatArray:
    """Return the centres of the ellipses that circles of a plane become under a homography.

    Parameters
    ----------
    pixel_from_plane
        (3, 3), any scale.
    centres
        (n, 2) of the circles, in the plane's unit.
    radius
        Of the circles, same unit.

    Returns
    -------
    centres_px : (n, 2)
        With Q = inv(H)' C inv(H) = [[A, b], [b', c]], the centre is -inv(A) b. In the adjugate
        D = H diag(r², r², -1) H' (circle about the origin) that is D[:2, 2] / D[2, 2].
    """
    H = np.asarray(pixel_from_plane, dtype=np.float64)
    centres = np.asarray(centres, dtype=np.float64)
    moved = np.broadcast_to(np.eye(3), (len(centres), 3, 3)).copy()
    moved[:, :2, 2] = centres
    moved = H @ moved
    dual = moved @ np.diag([radius**2, radius**2, -1.0]) @ moved.transpose(0, 2, 1)
    return np.asarray(dual[:, :2, 2] / dual[:, 2:, 2])


def area_centroids(boundaries_px: ArrayLike) -> FloatArray:
    """Return the centroids (n, 2) of the areas inside smooth closed curves (n, points, 2).

    By Green's theorem: with x(t), y(t) the curve, A = 1/2 int (x y' - y x') dt, and the centroid is
    1/(2A) int (x² y', -y² x') dt. Derivatives are those of the trigonometric polynomial through the points,
    so that a curve that is an even picture of a circle needs few of them (a polygon of 64 sides is off by
    0.16 % of what is wanted).
    """
    boundaries = np.asarray(boundaries_px, dtype=np.float64)
    count = boundaries.shape[1]
    middle = boundaries.mean(axis=1)
    x, y = np.moveaxis(boundaries - middle[:, None], -1, 0)
    frequency = 1j * np.fft.rfftfreq(count, 1.0 / count)
    if count % 2 == 0:
        frequency[-1] = 0.0
    dx, dy = (np.fft.irfft(frequency * np.fft.rfft(c, axis=1), count, axis=1) for c in (x, y))
    area = (x * dy - y * dx).sum(axis=1) / 2
    moments = np.stack([(x * x * dy).sum(axis=1), -(y * y * dx).sum(axis=1)], axis=-1)
    return np.asarray(middle + moments / (2 * area[:, None]))


def outline_points_m(centres_m: ArrayLike, radius_m: float) -> FloatArray:
    """Return boundary points (n, 32, 2) of circles about ``centres_m`` (n, 2), all in the circles' plane."""
    angle = np.arange(BOUNDARY_POINTS) * (2.0 * np.pi / BOUNDARY_POINTS)
    around = radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.asarray(np.asarray(centres_m, dtype=np.float64)[:, None, :] + around)


def bias_through(
    pixel_of: Callable[[FloatArray], FloatArray], centres_m: ArrayLike, radius_m: float
) -> FloatArray:
    """Return centroid of the dot's image minus image of its centre, (n, 2) px, for any map of the plane.

    ``pixel_of`` takes points (..., 2) of the plane, metres, to pixels (..., 2); centres (n, 2) and radius are
    metres. Not-a-number where the map has no pixel for some point of the boundary.
    """
    centres = np.asarray(centres_m, dtype=np.float64)
    boundaries = pixel_of(outline_points_m(centres, radius_m))
    return np.asarray(area_centroids(boundaries) - pixel_of(centres))


def centre_bias(
    camera: CameraModel, frame_from_board: Rigid, board: Board, rows: ArrayLike, columns: ArrayLike
) -> FloatArray:
    """Return by how much the middle of each dot's image differs from the image of its centre.

    Parameters
    ----------
    camera
        The model, in any frame.
    frame_from_board
        The board's pose in that frame.
    board
        Gives the dots' places and diameter.
    rows, columns
        (n,) which dots.

    Returns
    -------
    bias_px : (n, 2)
        Centroid of the dot's image minus projected centre: subtract it from a measured centroid. Exact for
        every model, to 1e-9 px. Not-a-number where the camera does not
        see the whole dot.
    """

    def pixel_of(points_m: FloatArray) -> FloatArray:
        in_board = np.concatenate([points_m, np.zeros_like(points_m[..., :1])], axis=-1)
        return camera.project(frame_from_board.points(in_board))[0]

    centres = board.dots_in_board_m(rows, columns)[:, :2]
    return bias_through(pixel_of, centres, board.dot_diameter_m / 2)
