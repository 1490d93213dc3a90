"""Pictures of the dot board, by casting the camera's own rays at the board's plane.

The centre of the top-left pixel is (0, 0). A pixel's value is the mean of samples x samples rays spread
evenly over its square: offsets (i + 0.5) / samples - 0.5 in x and in y. The board is thin and flat, hides
what is behind it and is hidden by nothing. Pictures are noise-free until ``photograph`` is called.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid
from calib.targets.boards import Board

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

OUTLINE_POINTS = 33  # along each side, to find the pixels that a bent outline covers
RAYS_AT_ONCE = 200_000


@dataclass(frozen=True)
class BoardLook:
    """Grey levels, 0 to 255, of paper and dots; how far the paper reaches beyond the outer dots' centres."""

    paper_dn: float = 205.0
    dot_dn: float = 35.0
    margin_m: float = 0.10


def draw_board(
    picture: ArrayLike,
    camera: CameraModel,
    frame_from_board: Rigid,
    board: Board,
    look: BoardLook | None = None,
    samples: int = 5,
) -> Float32:
    """Return the picture with a board in front of what it shows.

    Parameters
    ----------
    picture
        (h, w) grey levels, what is seen without the board; it is not changed.
    camera
        The model in any frame.
    frame_from_board
        The board's pose in that frame. Dots are on the side that z points away from; the back is plain paper.
    board
        Rows, columns, spacing and diameter.
    look
        Grey levels and margin; ``BoardLook()`` by default.
    samples
        Rays across a pixel on the edge of paper or dots. Pixels of one colour throughout need only one.

    Returns
    -------
    picture : (h, w) float32

    Raises
    ------
    ValueError
        If the picture is not of the camera's size.
    """
    look = look or BoardLook()
    drawn = np.array(picture, dtype=np.float32)
    width, height = camera.size_px
    if drawn.shape != (height, width):
        raise ValueError(f"a picture of {drawn.shape} where {(height, width)} is expected")
    left, top, right, bottom = _box_px(camera, frame_from_board, board, look)
    if right < left or bottom < top:
        return drawn
    seen = camera.moved(frame_from_board.inverse)
    y_px, x_px = np.mgrid[top : bottom + 1, left : right + 1]
    pixels = np.stack([x_px, y_px], axis=-1).reshape(-1, 2).astype(np.float64)

    # One ray a pixel tells where edges are near; only there the many are cast.
    hits, front = _hits_m(seen, pixels)
    covered, value, edge_m = _look_at(hits, front, board, look)
    grid = hits.reshape(bottom - top + 1, right - left + 1, 2)
    steps = [
        np.linalg.norm(np.diff(grid, axis=axis, append=np.take(grid, [-1], axis=axis)), axis=-1)
        for axis in (0, 1)
    ]
    reach_m = ndimage.maximum_filter(np.hypot(*steps), size=3).reshape(-1)
    near = ~(edge_m > 1.5 * reach_m)
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    within = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
    busy = np.flatnonzero(near)
    for k in range(0, len(busy), max(1, RAYS_AT_ONCE // len(within))):
        some = busy[k : k + max(1, RAYS_AT_ONCE // len(within))]
        many = (pixels[some, None, :] + within).reshape(-1, 2)
        c, v, _ = _look_at(*_hits_m(seen, many), board, look)
        shape = (len(some), len(within))
        covered[some] = c.reshape(shape).mean(axis=1)
        value[some] = (c * v).reshape(shape).mean(axis=1)
    value[~near] *= covered[~near]
    columns, rows = pixels.astype(int).T
    drawn[rows, columns] = drawn[rows, columns] * (1.0 - covered) + value
    return drawn


def photograph(
    picture: ArrayLike, blur_px: float, noise_dn: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Return the picture as a camera delivers it: blurred by the lens, noisy, in whole grey levels.

    ``blur_px`` and ``noise_dn`` are standard deviations of normal distributions.
    """
    blurred = np.asarray(picture, dtype=np.float32)
    if blur_px > 0.0:
        blurred = ndimage.gaussian_filter(blurred, blur_px, mode="nearest")
    noisy = blurred + np.float32(noise_dn) * rng.standard_normal(blurred.shape, dtype=np.float32)
    return np.asarray(np.clip(np.rint(noisy), 0, 255), dtype=np.uint8)


def half_size_m(board: Board, look: BoardLook) -> tuple[float, float]:
    """Return how far the paper reaches from the board's origin in x and in y."""
    x_m = (board.columns - 1) / 2 * board.spacing_m + look.margin_m
    return x_m, (board.rows - 1) / 2 * board.spacing_m + look.margin_m


def _box_px(
    camera: CameraModel, frame_from_board: Rigid, board: Board, look: BoardLook
) -> tuple[int, int, int, int]:
    """The pixels that may see the board: left, top, right, bottom, all inclusive, inside the image."""
    x_m, y_m = half_size_m(board, look)
    t = np.linspace(-1.0, 1.0, OUTLINE_POINTS)
    one = np.ones_like(t)
    sides = [(t, one), (t, -one), (one, t), (-one, t)]
    outline = np.concatenate([np.stack([x_m * x, y_m * y, 0 * x], axis=-1) for x, y in sides])
    pixels, valid = camera.project(frame_from_board.points(outline))
    width, height = camera.size_px
    if not valid.any():
        return 0, 0, -1, -1
    if not valid.all():
        return 0, 0, width - 1, height - 1
    low = np.maximum(np.floor(pixels.min(axis=0)) - 2, 0).astype(int)
    high = np.minimum(np.ceil(pixels.max(axis=0)) + 2, [width - 1, height - 1]).astype(int)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _hits_m(camera_in_board: CameraModel, pixels: Float64) -> tuple[Float64, NDArray[np.bool_]]:
    """Where the pixels' rays meet the board's plane, (n, 2), and whether they come from its front."""
    origins, directions, valid = camera_in_board.ray(pixels)
    with np.errstate(divide="ignore", invalid="ignore"):
        along = -origins[:, 2] / directions[:, 2]
        hits = origins[:, :2] + along[:, None] * directions[:, :2]
    hits[~(valid & (along > 0.0))] = np.nan
    return hits, np.asarray(directions[:, 2] > 0.0)


def _look_at(
    hits: Float64, front: NDArray[np.bool_], board: Board, look: BoardLook
) -> tuple[Float64, Float64, Float64]:
    """Return for points of the plane: 1 on the board else 0, its grey level, metres to the nearest edge."""
    half = np.array(half_size_m(board, look))
    inside_m = (half - np.abs(hits)).min(axis=-1)
    counts = np.array([board.columns, board.rows])
    middle = (counts - 1) / 2
    nearest = np.clip(np.rint(hits / board.spacing_m + middle), 0, counts - 1)
    off_m = np.linalg.norm(hits - (nearest - middle) * board.spacing_m, axis=-1) - board.dot_diameter_m / 2
    covered = (inside_m >= 0.0).astype(np.float64)
    value = np.where((off_m <= 0.0) & front, look.dot_dn, look.paper_dn)
    return covered, value, np.minimum(np.abs(inside_m), np.abs(off_m))
