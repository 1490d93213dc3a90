"""Targets as a person would choose them: in a view of the ground, on texture, seen by both cameras."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.errors import NoStereoPoint, Unreachable
from calib.geometry import pointing
from calib.geometry.cahvor import CameraModel
from calib.geometry.pointing import Solution, choose
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.geometry.stereo import triangulate
from calib.matching.partner import find_partner
from calib.matching.warp import PosedImage, grey
from drivers.interfaces import Image
from mastctl.answers import OperationTold
from mastctl.client import Client, ClientError, Snapshot

BORDER_PX = 64  # nearer the edge than this a person would turn the head first
TRIES_PER_VIEW = 8
RANGE_SLACK = 0.12  # a target counts as "at 10 m" within this share of the distance
TEXTURE_SIGMA_PX = 0.08  # what texture must hold a position to, one axis, at the grey noise below
NOISE_DN = 2.0


@dataclass(frozen=True, eq=False)
class Target:
    """A pixel of a snapshot, its partner in the other camera (``right_px`` of ``right``), and its range.

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
    """Return a random textured pixel of the left image at the distance, or None if a few tries find none.

    ``left`` and ``right`` are of one stereo pair with the head at rest, their camera models at that moment in
    the rover frame; the range from the left camera is within 12 % of ``distance_m``. The choice uses the two
    images before the move only, so it cannot favour targets that land well.
    """
    candidates = texture_mask(left.image)
    likely = candidates & on_level_ground(left_in_rover, distance_m)
    rows, columns = np.nonzero(likely if likely.any() else candidates)
    if len(rows) == 0:
        return None
    for pick in rng.integers(len(rows), size=TRIES_PER_VIEW):
        pixel = np.array([columns[pick], rows[pick]], dtype=np.float64)
        target = target_at(left, right, left_in_rover, right_in_rover, pixel)
        if target is not None and abs(target.range_m - distance_m) <= RANGE_SLACK * distance_m:
            return target
    return None


def target_at(
    left: Snapshot,
    right: Snapshot,
    left_in_rover: CameraModel,
    right_in_rover: CameraModel,
    pixel: FloatArray,
) -> Target | None:
    """Return the target at a pixel (2,) of the left picture; None where the right one has no good match."""
    own, other = PosedImage(grey(left.image), left_in_rover), PosedImage(grey(right.image), right_in_rover)
    found = find_partner(own, pixel, other)
    if found.match.verdict != "good":
        return None
    try:
        point_m = triangulate(left_in_rover, right_in_rover, pixel, found.match.pixel_px).position_m
    except NoStereoPoint:
        return None
    partner = (float(found.match.pixel_px[0]), float(found.match.pixel_px[1]))
    range_m = float(np.linalg.norm(point_m - left_in_rover.C))
    return Target(left, float(pixel[0]), float(pixel[1]), range_m, right, partner)


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


# A view that offers no usable target is left for another; after this many in a row the distance is given up.
VIEWS_PER_TARGET = 12
OPERATION_TIMEOUT_S = 60.0
STOP_TIMEOUT_S = 30.0


@dataclass(frozen=True)
class TargetViews:
    """Views of one stereo pair on the head, at random azimuths within ``pan_range_rad`` of straight ahead."""

    client: Client
    rig: Rig
    pair: tuple[str, str]
    limits: Mapping[str, Any]
    rng: np.random.Generator
    pan_range_rad: float

    def find_target(self, distance_m: float) -> Target | None:
        """Turn to a random piece of ground at the distance and choose a pixel there, if it offers one.

        Raises ClientError if the daemon does not turn the head or gives no images.
        """
        pair = self.look_at(self._ground_ahead(distance_m))
        if pair is None:
            return None
        models = tuple(self.rig.camera_in_rover(shot.camera, *shot.true_rad) for shot in pair)
        return choose_target(*pair, models[0], models[1], distance_m, self.rng)

    def look_at(self, point_m: FloatArray) -> tuple[Snapshot, Snapshot] | None:
        """Turn to a point (3,) of the rover frame and take both images; None outside the head's limits.

        Raises ClientError if the daemon does not turn the head or gives no images.
        """
        try:
            solutions = pointing.solve(self.rig.mast, self.rig.cameras[self.pair[0]].model, point_m)
            joints = self.rig.joints
            angles = choose(
                [Solution(*joints.read_rad((one.pan_rad, one.tilt_rad)), one.range_m) for one in solutions],
                tuple(self.limits["pan_rad"]),
                tuple(self.limits["tilt_rad"]),
            )
        except Unreachable:
            return None
        operation = pointed(self.client, pan_rad=angles.pan_rad, tilt_rad=angles.tilt_rad)
        if operation["state"] != "done":
            error = operation["error"] or {"code": operation["state"], "message": "the move was stopped"}
            raise ClientError(error["code"], error["message"])
        return self.client.snapshot(self.pair[0]), self.client.snapshot(self.pair[1])

    def _ground_ahead(self, distance_m: float) -> FloatArray:
        """A point (3,) of level ground at the range from the head, anywhere ahead, rover frame."""
        head_in_rover_m = self.rig.mast.rover_from_head(0.0, 0.0).translation_m
        height_m = float(head_in_rover_m[2])
        along_m = math.sqrt(max(distance_m**2 - height_m**2, 0.0))
        azimuth_rad = self.rng.uniform(-self.pan_range_rad, self.pan_range_rad)
        return np.array(
            [
                head_in_rover_m[0] + along_m * math.cos(azimuth_rad),
                head_in_rover_m[1] + along_m * math.sin(azimuth_rad),
                0.0,
            ]
        )


def pointed(client: Client, **request: Any) -> OperationTold:
    """Have the daemon point as `Client.point` says; return the ended operation's record.

    Raises ClientError if it refuses; ``timeout``, if it has not ended in time: it is stopped then, so that
    the next one can begin.
    """
    operation = client.point(**request)
    try:
        return client.wait(operation, timeout_s=OPERATION_TIMEOUT_S)
    except ClientError as error:
        if error.code == "timeout":
            with suppress(ClientError):  # what took too long is reported, not what the stop met
                client.stop_operation(operation)
                client.wait(operation, timeout_s=STOP_TIMEOUT_S)
        raise
