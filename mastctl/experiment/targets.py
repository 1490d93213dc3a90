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
from mastctl.answers import OperationAnswer
from mastctl.client import Client, ClientError, Snapshot

BORDER_PX = 64  # nearer the edge than this a person would turn the head first
TRIES_PER_VIEW = 8
RANGE_SLACK = 0.12  # share of the distance within which a target is treated as "at 10 m"
VIEWS_PER_TARGET = 12  # a view without a usable target is left for another; then the distance is given up
OPERATION_TIMEOUT_S, STOP_TIMEOUT_S = 60.0, 30.0
TEXTURE_SIGMA_PX = 0.08  # how sharply texture must fix a position, one axis, at the grey noise below
NOISE_DN = 2.0


@dataclass(frozen=True, eq=False)
class Target:
    """A pixel of a snapshot, its partner in the other camera (``right_px`` of ``right``), and its range."""

    shot: Snapshot
    x_px: float
    y_px: float
    range_m: float
    right: Snapshot
    right_px: tuple[float, float]


def on_level_ground(camera_in_rover: CameraModel, distance_m: float) -> NDArray[np.bool_]:
    """Return a mask (h, w) of pixels that see level ground (z = 0) near the distance, to save tries."""
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
    """Return a mask (h, w) of pixels whose surroundings fix a position to 0.08 px an axis at 2 DN of noise.

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
        """Turn to a random piece of ground at the distance and choose a textured pixel there, if it has one.

        The range from the left camera is within `RANGE_SLACK` of the distance. Raises ClientError if the
        daemon does not turn the head or gives no images.
        """
        pair = self._snapshots_of(self._ground_ahead(distance_m))
        if pair is None:
            return None
        left, right = (
            PosedImage(grey(shot.image), self.rig.camera_in_rover(shot.camera, *shot.true_rad))
            for shot in pair
        )
        # Chosen by images before the move only, so the choice cannot favour targets that land well.
        candidates = texture_mask(pair[0].image)
        likely = candidates & on_level_ground(left.camera, distance_m)
        rows, columns = np.nonzero(likely if likely.any() else candidates)
        for pick in self.rng.integers(len(rows), size=TRIES_PER_VIEW) if len(rows) else ():
            pixel = np.array([columns[pick], rows[pick]], dtype=np.float64)
            match = find_partner(left, pixel, right).match
            if match.verdict != "good":
                continue
            try:
                point_m = triangulate(left.camera, right.camera, pixel, match.pixel_px).position_m
            except NoStereoPoint:
                continue
            range_m = float(np.linalg.norm(point_m - left.camera.C))
            if abs(range_m - distance_m) <= RANGE_SLACK * distance_m:
                partner = (float(match.pixel_px[0]), float(match.pixel_px[1]))
                return Target(pair[0], float(pixel[0]), float(pixel[1]), range_m, pair[1], partner)
        return None

    def _snapshots_of(self, point_m: FloatArray) -> tuple[Snapshot, Snapshot] | None:
        """Turn to a point (3,) of the rover frame and take both images; None outside the head's limits."""
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
        ahead = along_m * np.array([math.cos(azimuth_rad), math.sin(azimuth_rad)])
        return np.array([*(head_in_rover_m[:2] + ahead), 0.0])


def pointed(client: Client, **request: Any) -> OperationAnswer:
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
