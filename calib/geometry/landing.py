"""Where a target lands, in pixels, when a rig points at it whose numbers are not quite true.

A target is clicked in a pair of cameras at one attitude of the head, ranged by it, and brought to a wanted
pixel by the closed form. Errors of the rig's parameters move the ranged place p, and the direction in which
the head then points. With the picture of the landing as truth the residual e is, to first order,

    e = -(d pixel / d rig + d pixel / d p . d p / d rig),    d p / d rig = -d p / d clicks . d clicks / d rig,

so that errors which ranging and pointing share cancel. A single camera is given the range.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from calib.errors import CalibError
from calib.geometry.covariance import JOINT_NAMES, pixel_rates, place_rates
from calib.geometry.pointing import solve
from calib.geometry.rig import UNKNOWN, Approach, Rig
from calib.geometry.rigid import FloatArray


class LandingRates(NamedTuple):
    """How far a target lands off, to first order: pixels for errors of the named parameters (2, p) and of the
    clicks in k cameras (2, 2k); pixels a radian for pan and tilt at the click, and at the landing (2, 4)."""

    to_rig: FloatArray
    to_clicks: FloatArray
    to_readings: FloatArray


def landing_rates(
    rig: Rig,
    names: Sequence[str],
    cameras: Sequence[str],
    pan_rad: float,
    tilt_rad: float,
    target_m: FloatArray,
    approaches: tuple[Approach, Approach] = (UNKNOWN, UNKNOWN),
) -> LandingRates:
    """Return how a target's landing in the middle of the first camera's image depends on what may be off.

    Parameters
    ----------
    names
        Which of the rig's parameters (p,) may be off (`calib.geometry.covariance.pixel_rates`).
    cameras
        Of the head: the pair in which it is clicked, left one first, or one camera that is given the range.
    pan_rad, tilt_rad
        True angles at which it is clicked.
    target_m
        (3,) the target, rover frame.
    approaches
        From where the axes came to the click, and to the landing.

    Raises
    ------
    CalibError
        If a camera does not see the target, or it cannot be pointed at.
    """
    every, size = (*names, *JOINT_NAMES), len(names)
    place = place_rates(rig, every, cameras, pan_rad, tilt_rad, target_m, approaches[0])
    camera, model = cameras[0], rig.cameras[cameras[0]].model
    at = solve(rig.mast, model, target_m, from_pan_rad=pan_rad, from_tilt_rad=tilt_rad)[0]
    landed = pixel_rates(rig, every, camera, at.pan_rad, at.tilt_rad, target_m[None], approaches[1])
    by_place, by_rig = landed.to_points[0], landed.to_rig[0]
    if not np.isfinite(by_rig).all():
        raise CalibError(f"camera {camera} does not see the target where it should land")
    clicking = by_place @ place.to_rig
    return LandingRates(
        -(by_rig[:, :size] + clicking[:, :size]),
        -by_place @ place.to_clicks,
        -np.hstack([clicking[:, size:], by_rig[:, size:]]),
    )
