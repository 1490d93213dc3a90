"""Looking for targets with a running daemon: turn to ground at a distance, take two pictures, choose."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from calib import pointing
from calib.errors import Unreachable
from calib.mast import Rig
from mastctl.client import Client, ClientError
from mastctl.experiment.targets import Target, choose_target

# A view that offers no usable target is left for another; after this many in a row the distance is given up.
VIEWS_PER_TARGET = 12
OPERATION_TIMEOUT_S = 60.0


class Views:
    """Views of one stereo pair on the head, at random azimuths within ``pan_range_rad`` of straight ahead."""

    def __init__(
        self,
        client: Client,
        rig: Rig,
        pair: tuple[str, str],
        limits: Mapping[str, Any],
        rng: np.random.Generator,
        pan_range_rad: float,
    ) -> None:
        self._client = client
        self._rig = rig
        self._pair = pair
        self._pan_limits_rad = (float(limits["pan_rad"][0]), float(limits["pan_rad"][1]))
        self._tilt_limits_rad = (float(limits["tilt_rad"][0]), float(limits["tilt_rad"][1]))
        self._rng = rng
        self._pan_range_rad = pan_range_rad

    def find_target(self, distance_m: float) -> Target | None:
        """Turn to a random piece of ground at the distance and choose a pixel there, if it offers one.

        Raises
        ------
        ClientError
            If the daemon does not turn the head or gives no pictures.
        """
        angles = self._angles_towards(distance_m)
        if angles is None:
            return None
        operation = self._client.wait(
            self._client.point(pan_rad=angles[0], tilt_rad=angles[1]), timeout_s=OPERATION_TIMEOUT_S
        )
        if operation["state"] != "done":
            error = operation.get("error") or {}
            raise ClientError(
                str(error.get("code", operation["state"])), str(error.get("message", "the move was stopped"))
            )
        left, right = (self._client.snapshot(camera) for camera in self._pair)
        models = tuple(
            self._rig.camera_in_rover(shot.camera, shot.pan_rad, shot.tilt_rad) for shot in (left, right)
        )
        return choose_target(left, right, models[0], models[1], distance_m, self._rng)

    def _angles_towards(self, distance_m: float) -> tuple[float, float] | None:
        """Joint angles that look at level ground at the range, anywhere ahead; None outside the limits."""
        mast = self._rig.mast
        head_in_rover_m = mast.rover_from_head(0.0, 0.0).translation_m
        height_m = -float(head_in_rover_m[2])
        along_m = math.sqrt(max(distance_m**2 - height_m**2, 0.0))
        azimuth_rad = self._rng.uniform(-self._pan_range_rad, self._pan_range_rad)
        point_m = np.array(
            [
                head_in_rover_m[0] + along_m * math.cos(azimuth_rad),
                head_in_rover_m[1] + along_m * math.sin(azimuth_rad),
                0.0,
            ]
        )
        try:
            solutions = pointing.solve(mast, self._rig.cameras[self._pair[0]].model, point_m)
            chosen = pointing.choose(solutions, self._pan_limits_rad, self._tilt_limits_rad)
        except Unreachable:
            return None
        return chosen.pan_rad, chosen.tilt_rad
