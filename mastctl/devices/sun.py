"""The sun, or a lamp: a cone around a direction that no head camera's optical axis may enter, as boxes.

A camera's axis v(tilt) = Rx(k) Ry(tilt) A turns with pan about the mast's z. At one tilt the pans at which it
stands within an angle of the direction are one interval in closed form. Over a row of tilts that is h high to
either side of its middle the axis turns by h at most, so that the interval at the middle for an angle larger
by h holds those of the whole row: the boxes hold the cone, and nothing beyond twice h around it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, rot_x, rot_y
from mastctl.devices.keep_out import Box, Pair

SUN = "sun"
ROWS = 16  # over a cone's height: a row is an eighth of the half angle high
LEAST_ROW_RAD = 0.004
OVERLAP_RAD = 1e-6  # of rows: boxes are open, and two that only touch would leave a crack between them
LEAST_CONE_RAD, WIDEST_CONE_RAD = 0.001, 1.5

Frame = Literal["rover", "site"]


@dataclass(frozen=True)
class Sun:
    """Where it stands and how near a camera may look.

    Attributes
    ----------
    direction
        Unit vector towards it in ``frame``: x forward (north), y right (east), z down.
    frame
        ``rover``, or ``site``: then it turns with the rover's pose.
    half_angle_rad
        Of the cone around it.
    until_s
        When it holds no longer, seconds of CLOCK_MONOTONIC; None: until another is told.
    """

    direction: tuple[float, float, float]
    frame: Frame
    half_angle_rad: float
    until_s: float | None = None

    def holds(self, now_s: float) -> bool:
        """Return whether it is still true at a moment."""
        return self.until_s is None or now_s <= self.until_s


def direction_of(azimuth_rad: float, elevation_rad: float) -> tuple[float, float, float]:
    """Return a unit vector: azimuth from x over y, elevation above the xy plane, z down."""
    level = math.cos(elevation_rad)
    return level * math.cos(azimuth_rad), level * math.sin(azimuth_rad), -math.sin(elevation_rad)


def sun_boxes(rig: Rig, in_rover: FloatArray, half_angle_rad: float, tilt_rad: Pair) -> tuple[Box, ...]:
    """Return boxes that together hold every pose in which a head camera looks into the cone.

    Parameters
    ----------
    rig
        The mast file's content; body cameras do not turn and are left aside.
    in_rover
        (3,) unit vector towards the sun, rover frame.
    half_angle_rad
        Of the cone.
    tilt_rad
        The range of true tilt that is wanted; the boxes are of true angles too.
    """
    sun = rig.mast.rover_from_mast.rotation.T @ in_rover
    axes = {tuple(camera.model.A.tolist()) for camera in rig.cameras.values() if camera.on == "head"}
    step = max(2.0 * half_angle_rad / ROWS, LEAST_ROW_RAD)
    rows = max(1, math.ceil((tilt_rad[1] - tilt_rad[0]) / step))
    step = (tilt_rad[1] - tilt_rad[0]) / rows
    found = []
    for number in range(rows):
        middle = tilt_rad[0] + (number + 0.5) * step
        turned = rot_x(rig.mast.axis_twist_rad) @ rot_y(middle)
        pans = [
            pan
            for axis in axes
            for pan in _pans(turned @ np.array(axis), sun, half_angle_rad + 0.5 * step + OVERLAP_RAD)
        ]
        row = middle - 0.5 * step - OVERLAP_RAD, middle + 0.5 * step + OVERLAP_RAD
        found += [Box(SUN, pan, row) for pan in _joined(pans)]
    return tuple(found)


def _pans(axis: FloatArray, sun: FloatArray, angle_rad: float) -> Iterator[Pair]:
    """The interval of pan at which an axis stands within an angle of the sun, both in the mast frame."""
    level = math.hypot(axis[0], axis[1]) * math.hypot(sun[0], sun[1])
    wanted = math.cos(min(angle_rad, math.pi)) - float(axis[2] * sun[2])
    if wanted > level:
        return
    middle = math.atan2(sun[1], sun[0]) - math.atan2(axis[1], axis[0])
    half = math.pi + OVERLAP_RAD if wanted <= -level else math.acos(wanted / level)
    middle = math.remainder(middle, math.tau)
    yield middle - half, middle + half


def _joined(pans: list[Pair]) -> list[Pair]:
    """Overlapping intervals as one, those that touch round the circle too."""
    joined: list[Pair] = []
    for low, high in sorted(pans):
        if joined and low <= joined[-1][1]:
            joined[-1] = joined[-1][0], max(joined[-1][1], high)
        else:
            joined.append((low, high))
    return joined
