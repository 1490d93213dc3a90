"""How a rig's pixels, and the clicks of a point, depend on the rig's parameters and on the joints.

Derivatives in closed form, of the camera's (`calib.camera.parameters`) and the mast's (`calib.mast.gimbal`).
Names are those of `calib.mast.covariance`, and ``JOINT_NAMES`` beside them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.camera.parameters import parameter_names, predict
from calib.mast.covariance import RigCovariance
from calib.mast.gimbal import MAST_NAMES, gimbal, gimbal_rates, numbers_of
from calib.mast.joints import AXIS_NAMES, JOINTS_NAMES, UNKNOWN, Approach
from calib.mast.rig import Rig
from calib.rigid import FloatArray

JOINT_NAMES = ("pan_rad", "tilt_rad")

_GIMBAL_NAMES = (*(f"mast.{name}" for name in MAST_NAMES), *JOINT_NAMES)
"""A gimbal's ten numbers."""


def pixel_rates(
    rig: Rig,
    names: Sequence[str],
    camera: str,
    pan_rad: float,
    tilt_rad: float,
    points_m: FloatArray,
    approach: Approach = UNKNOWN,
) -> tuple[FloatArray, FloatArray]:
    """Return pixels (n, 2) of rover-frame points (n, 3) and their derivatives (n, 2, p) to named parameters.

    ``names`` (p,) are ``mast.KEY.x``, ``joints.pan.c1`` (the readings held), ``cameras.NAME.C.x``,
    ``pan_rad`` and ``tilt_rad``; what is not among them is held. The angles are true ones; from which side
    the axes came there says how the backlash counts.
    """
    held = rig.cameras[camera]
    at = {name: i for i, name in enumerate(names)}
    out = np.zeros((len(points_m), 2, len(names)))
    if held.on == "rover":
        seen = predict(held.model, points_m)
    else:
        head = gimbal(numbers_of(rig.mast), pan_rad, tilt_rad)
        seen = predict(held.model, (points_m - head.translation_m) @ head.rotation)
        erring = [name for name in JOINTS_NAMES if name in at]
        free = np.array(
            [i for i, name in enumerate(_GIMBAL_NAMES) if name in at or (erring and name in JOINT_NAMES)],
            dtype=int,
        )
        rates = -gimbal_rates(seen.d_points @ head.rotation.T, points_m, head, free)
        for column, i in enumerate(free):
            if _GIMBAL_NAMES[i] in at:
                out[..., at[_GIMBAL_NAMES[i]]] = rates[..., column]
        if erring:  # the last two columns are then those of pan and tilt
            by_joints = _joint_rates(rig, (pan_rad, tilt_rad), approach)
            for name in erring:
                number = JOINTS_NAMES.index(name)
                axis = number // len(AXIS_NAMES)
                out[..., at[name]] = rates[..., axis - 2] * by_joints[number]
    mine = [f"cameras.{camera}.{part}" for part in parameter_names(held.model.kind)]
    known = [i for i, name in enumerate(mine) if name in at]
    out[..., [at[mine[i]] for i in known]] = seen.d_step[..., known]
    return seen.pixels_px, out


def _joint_rates(rig: Rig, true_rad: tuple[float, float], approach: Approach) -> FloatArray:
    """(10,) how each joint's true angle changes with the numbers of `JOINTS_NAMES`, its reading held."""
    read = rig.joints.read_rad(true_rad, approach)
    axes = zip((rig.joints.pan, rig.joints.tilt), read, approach, strict=True)
    return np.concatenate([joint.rates(at, side) for joint, at, side in axes])


def click_rates(
    rig: Rig,
    names: Sequence[str],
    cameras: Sequence[str],
    pan_rad: float,
    tilt_rad: float,
    position_m: FloatArray,
    approach: Approach = UNKNOWN,
) -> FloatArray:
    """Return (2k, p): how far the clicks of a point in k cameras seem shifted as parameters change.

    A model that moves its pixel of a point by something puts a click's ray where a click moved the other way
    would. That is exact where the rays meet; where they pass each other it leaves out a part as small as
    their gap beside the baseline.
    """
    point = position_m[None]
    return -np.concatenate(
        [pixel_rates(rig, names, camera, pan_rad, tilt_rad, point, approach)[1][0] for camera in cameras]
    )


def click_covariance(
    rig: Rig,
    cameras: Sequence[str],
    pan_rad: float,
    tilt_rad: float,
    position_m: FloatArray,
    *,
    sigma_px: float,
    sigma_rad: float = 0.0,
    calibration: RigCovariance | None = None,
) -> FloatArray:
    """Return the covariance (2k, 2k), px², of a point's clicks in k cameras and of all that is off with them.

    Parameters
    ----------
    rig, cameras, pan_rad, tilt_rad
        Who sees it, and the true joint angles.
    position_m
        (3,) the point, rover frame.
    sigma_px, sigma_rad
        Of each pixel coordinate of a click, and of each joint reading.
    calibration
        Covariance of the rig; exact when left out.
    """
    total = sigma_px * sigma_px * np.eye(2 * len(cameras))
    known = calibration.of(cameras) if calibration else None
    names = (*(known.names if known else ()), *JOINT_NAMES)
    rates = click_rates(rig, names, cameras, pan_rad, tilt_rad, position_m)
    if known:
        by_rig = rates[:, : len(known.names)]
        total += by_rig @ known.covariance @ by_rig.T
    turned = rates[:, -2:]
    return np.asarray(total + sigma_rad * sigma_rad * (turned @ turned.T))
