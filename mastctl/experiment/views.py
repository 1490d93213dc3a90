"""Looking for targets with a running daemon: turn to ground at a distance, take two pictures, choose."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from calib.errors import Unreachable
from calib.mast import pointing
from calib.mast.rig import Rig
from calib.mast.solutions import Solution, choose
from calib.rigid import FloatArray
from mastctl.client import Client, ClientError, Snapshot
from mastctl.client.answers import OperationTold
from mastctl.experiment.targets import Target, choose_target

# A view that offers no usable target is left for another; after this many in a row the distance is given up.
VIEWS_PER_TARGET = 12
OPERATION_TIMEOUT_S = 60.0
STOP_TIMEOUT_S = 30.0


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
        pair = self.look_at(self._ground_ahead(distance_m))
        if pair is None:
            return None
        models = tuple(self._rig.camera_in_rover(shot.camera, *shot.true_rad) for shot in pair)
        return choose_target(*pair, models[0], models[1], distance_m, self._rng)

    def look_at(self, point_m: FloatArray) -> tuple[Snapshot, Snapshot] | None:
        """Turn to a point (3,) of the rover frame and take both pictures; None outside the head's limits.

        Raises
        ------
        ClientError
            If the daemon does not turn the head or gives no pictures.
        """
        try:
            solutions = pointing.solve(self._rig.mast, self._rig.cameras[self._pair[0]].model, point_m)
            joints = self._rig.joints
            angles = choose(
                [Solution(*joints.read_rad((one.pan_rad, one.tilt_rad)), one.range_m) for one in solutions],
                self._pan_limits_rad,
                self._tilt_limits_rad,
            )
        except Unreachable:
            return None
        operation = pointed(self._client, pan_rad=angles.pan_rad, tilt_rad=angles.tilt_rad)
        if operation["state"] != "done":
            error = operation["error"] or {"code": operation["state"], "message": "the move was stopped"}
            raise ClientError(error["code"], error["message"])
        return self._client.snapshot(self._pair[0]), self._client.snapshot(self._pair[1])

    def _ground_ahead(self, distance_m: float) -> FloatArray:
        """A point (3,) of level ground at the range from the head, anywhere ahead, rover frame."""
        head_in_rover_m = self._rig.mast.rover_from_head(0.0, 0.0).translation_m
        height_m = -float(head_in_rover_m[2])
        along_m = math.sqrt(max(distance_m**2 - height_m**2, 0.0))
        azimuth_rad = self._rng.uniform(-self._pan_range_rad, self._pan_range_rad)
        return np.array(
            [
                head_in_rover_m[0] + along_m * math.cos(azimuth_rad),
                head_in_rover_m[1] + along_m * math.sin(azimuth_rad),
                0.0,
            ]
        )


def pointed(client: Client, **request: Any) -> OperationTold:
    """Have the daemon point as `Client.point` says; return the ended operation's record.

    Raises
    ------
    ClientError
        If it refuses; ``timeout``, if it has not ended in time. It is stopped then, so that the next one can
        begin.
    """
    try:
        return client.wait(client.point(**request), timeout_s=OPERATION_TIMEOUT_S)
    except ClientError as error:
        if error.code == "timeout":
            with suppress(ClientError):  # what took too long is told, not what the stop met
                stopped = client.stop()["operation"]
                if stopped is not None:
                    client.wait(stopped, timeout_s=STOP_TIMEOUT_S)
        raise
