"""Points whose place is known from elsewhere than the pictures: the corners and faces of simulated bricks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from calib.rigid import FloatArray
from drivers.sim.rover import SimulatedRover
from mastctl.devices.frames import camera_and_sequence

HIDDEN_M = 0.003
"""What stands before a point by less does not hide it: a ray at a corner meets the brick there or passes."""


@dataclass(frozen=True, eq=False)
class KnownPoint:
    """A point (3,) of the rover frame; points of one ``group`` lie near each other."""

    kind: str
    group: int
    position_m: FloatArray


class KnownPoints(Protocol):
    """Known points, and where frames truly show them."""

    def points(self) -> Sequence[KnownPoint]:
        """All of them, group by group."""

    def seen_px(self, frame_id: str, position_m: FloatArray) -> tuple[float, float] | None:
        """Where a frame shows a point; None if it is hidden or outside."""


class BrickPoints:
    """Corners and middles of faces of the simulated rover's bricks."""

    def __init__(self, rover: SimulatedRover) -> None:
        self._rover = rover

    def points(self) -> Sequence[KnownPoint]:
        """See `KnownPoints`."""
        rover_from_site = self._rover.site_from_rover.inverse
        found = []
        for group, brick in enumerate(self._rover.scene.bricks):
            # the corners at the bottom are in the ground
            for kind, places in (("corner", brick.corners_m[:4]), ("face", brick.faces_m)):
                found += [KnownPoint(kind, group, one) for one in np.asarray(rover_from_site.points(places))]
        return found

    def seen_px(self, frame_id: str, position_m: FloatArray) -> tuple[float, float] | None:
        """See `KnownPoints`."""
        truth = self._rover.frame_truth(*camera_and_sequence(frame_id))
        camera = truth.camera_in_rover
        pixel, valid = camera.project(position_m)
        if not valid or not camera.holds(pixel):
            return None
        ray = camera.ray(pixel)
        met_m = self._rover.scene.cast(
            truth.site_from_rover.points(ray.origins_m), truth.site_from_rover.vectors(ray.directions)
        )
        if float(met_m) < float(np.linalg.norm(position_m - ray.origins_m)) - HIDDEN_M:
            return None
        return float(pixel[0]), float(pixel[1])
