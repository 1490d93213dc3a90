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
from calib.geometry.covariance import JOINT_NAMES, pixel_rates
from calib.geometry.pointing import solve
from calib.geometry.rig import UNKNOWN, Approach, Rig
from calib.geometry.rigid import FloatArray
from calib.geometry.stereo import triangulate


class LandingRates(NamedTuple):
    """How far a target lands off, to first order.

    Attributes
    ----------
    to_rig
        (2, p) pixels for the errors of the named parameters.
    to_clicks
        (2, 2k) for those of the clicks in k cameras.
    to_readings
        (2, 4) for the errors of pan and tilt at the click, and of both at the landing; pixels a radian.
    """

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
    rig, names
        The rig, and which of its parameters (p,) may be off (`calib.geometry.covariance.pixel_rates`).
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
    clicked = [
        pixel_rates(rig, every, camera, pan_rad, tilt_rad, target_m[None], approaches[0])
        for camera in cameras
    ]
    models = [rig.camera_in_rover(camera, pan_rad, tilt_rad) for camera in cameras]
    for camera, seen in zip(cameras, clicked, strict=True):
        if not (np.isfinite(seen.pixels_px).all() and np.isfinite(seen.to_rig).all()):
            raise CalibError(f"camera {camera} does not see the target at {target_m.round(3).tolist()} m")
    if len(cameras) == 1:
        along = models[0].ray(clicked[0].pixels_px[0]).directions
        by_clicks = np.linalg.inv(np.vstack([clicked[0].to_points[0], along]))[:, :2]
    else:
        (left, right), (one, other) = models, (seen.pixels_px[0] for seen in clicked)
        by_clicks = triangulate(left, right, one, other).rates_m_per_px
    place = -by_clicks @ np.concatenate([seen.to_rig[0] for seen in clicked])
    model = rig.cameras[cameras[0]].model
    angles = solve(rig.mast, model, target_m, from_pan_rad=pan_rad, from_tilt_rad=tilt_rad)[0]
    landed = pixel_rates(
        rig, every, cameras[0], angles.pan_rad, angles.tilt_rad, target_m[None], approaches[1]
    )
    if not np.isfinite(landed.to_rig).all():
        raise CalibError(f"camera {cameras[0]} does not see the target where it should land")
    by_place, by_rig = landed.to_points[0], landed.to_rig[0]
    clicking = by_place @ place
    return LandingRates(
        -(by_rig[:, :size] + clicking[:, :size]),
        -by_place @ by_clicks,
        -np.hstack([clicking[:, size:], by_rig[:, size:]]),
    )
