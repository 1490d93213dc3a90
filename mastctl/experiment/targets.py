"""Choosing a target as a person would: anywhere in the picture, on texture, seen by both eyes."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.camera.cahvor import CameraModel
from calib.camera.stereo import triangulate
from calib.errors import NoStereoPoint
from calib.pictures.epipolar import find_partner
from calib.pictures.warp import grey
from calib.rigid import FloatArray
from drivers.interfaces import Image
from mastctl.client import Snapshot

BORDER_PX = 64  # nearer the edge than this a person would turn the head first
TRIES_PER_VIEW = 8
RANGE_SLACK = 0.12  # a target counts as "at 10 m" within this share of the distance
TEXTURE_SIGMA_PX = 0.08  # what texture must hold a position to, one axis, at the grey noise below
NOISE_DN = 2.0


@dataclass(frozen=True, eq=False)
class Target:
    """A pixel of a snapshot, its partner in the other eye (``right_px`` of ``right``), and its range.

    ``kind`` says what it is: ``ground`` for a pixel chosen by its texture. ``point_m`` (3,) is where it is in
    the rover frame, if that is known from elsewhere.
    """

    shot: Snapshot
    x_px: float
    y_px: float
    range_m: float
    right: Snapshot
    right_px: tuple[float, float]
    kind: str = "ground"
    point_m: FloatArray | None = None


def choose_target(
    left: Snapshot,
    right: Snapshot,
    left_in_rover: CameraModel,
    right_in_rover: CameraModel,
    distance_m: float,
    rng: np.random.Generator,
) -> Target | None:
    """Return a random textured pixel of the left picture at the distance, or None if a few tries find none.

    The choice looks at the two pictures before the move only, so it cannot favour targets that land well.

    Parameters
    ----------
    left, right
        Pictures of one stereo pair with the head at rest.
    left_in_rover, right_in_rover
        The camera models at the pictures' joint angles, rover frame.
    distance_m
        Wanted range from the left camera, metres; kept to within 12 %.
    rng
        Chooses.
    """
    candidates = texture_mask(left.image)
    likely = candidates & on_level_ground(left_in_rover, distance_m)
    rows, columns = np.nonzero(likely if likely.any() else candidates)
    if len(rows) == 0:
        return None
    images = grey(left.image), grey(right.image)
    for pick in rng.integers(len(rows), size=TRIES_PER_VIEW):
        pixel = np.array([columns[pick], rows[pick]], dtype=np.float64)
        found = find_partner(images[0], left_in_rover, pixel, images[1], right_in_rover)
        if found.match.verdict != "good":
            continue
        try:
            point = triangulate(left_in_rover, right_in_rover, pixel, found.match.pixel_px).position_m
        except NoStereoPoint:
            continue
        range_m = float(np.linalg.norm(point - left_in_rover.C))
        if abs(range_m - distance_m) <= RANGE_SLACK * distance_m:
            partner = (float(found.match.pixel_px[0]), float(found.match.pixel_px[1]))
            return Target(left, float(pixel[0]), float(pixel[1]), range_m, right, partner)
    return None


def on_level_ground(camera_in_rover: CameraModel, distance_m: float) -> NDArray[np.bool_]:
    """Return a mask (h, w) of pixels that see level ground (z = 0) near the distance.

    It only saves tries: what counts is the range that stereo measures.
    """
    width, height = camera_in_rover.size_px
    step = 8
    columns, rows = np.meshgrid(
        np.arange(0, width, step, dtype=float), np.arange(0, height, step, dtype=float)
    )
    rays = camera_in_rover.ray(np.stack([columns, rows], axis=-1))
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges_m = -rays.origins_m[..., 2] / rays.directions[..., 2]
        near = np.abs(ranges_m - distance_m) <= RANGE_SLACK * distance_m
    return np.repeat(np.repeat(near, step, axis=0), step, axis=1)[:height, :width]


def texture_mask(image: Image) -> NDArray[np.bool_]:
    """Return a mask (h, w) of pixels whose surroundings hold a position to 0.08 px an axis at 2 DN of noise.

    The smaller eigenvalue of the gradient's structure tensor over 41x41 px bounds the variance of a match.
    """
    side = 41
    picture = cv2.GaussianBlur(grey(image), (0, 0), 1.0)
    # OpenCV's gradients are Sobel sums over 4 * side, where a slope of one grey a pixel sums to 8.
    smaller = cv2.cornerMinEigenVal(picture, side, ksize=3) * side * side / 4.0
    mask = smaller > 2.0 * (NOISE_DN / TEXTURE_SIGMA_PX) ** 2
    mask[:BORDER_PX] = mask[-BORDER_PX:] = False
    mask[:, :BORDER_PX] = mask[:, -BORDER_PX:] = False
    return np.asarray(mask, dtype=np.bool_)
