"""A rig with a corrected body pair, and the covariance that it then has.

With e what the rig's parameters are wrong by, the hand-offs' residuals are G e + noise, and the step is K
times them. What remains, e - LK (G e + noise), has the covariance (1 - LKG) P (1 - LKG)ᵀ + LK R (LK)ᵀ
(Joseph's form, right for any K). It ties the corrected cameras to mast and mast cameras, which they were
corrected by.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.camera.cahvor import CameraModel
from calib.camera.parameters import parameter_names, parameter_part
from calib.handoff.body_pose import BodyPose
from calib.mast.covariance import RigCovariance
from calib.mast.rig import Rig
from calib.mast.rig_rates import click_rates, pixel_rates
from calib.rigid import FloatArray, rigid_rates, tangents


def corrected_rig(rig: Rig, correction: BodyPose) -> Rig:
    """Return the rig with the correction's cameras moved; mast, head cameras and ``fit`` as they were."""
    cameras = dict(rig.cameras)
    for name in correction.cameras:
        cameras[name] = replace(cameras[name], model=cameras[name].model.moved(correction.motion))
    return replace(rig, cameras=cameras)


def corrected_covariance(rig: Rig, known: RigCovariance, correction: BodyPose) -> RigCovariance:
    """Return the covariance of the corrected rig's parameters.

    Parameters
    ----------
    rig, known
        Before the correction.
    correction
        Of cameras of that rig.
    """
    size = len(known.names)
    per_step, carried = np.zeros((size, 6)), np.eye(size)
    at = {name: i for i, name in enumerate(known.names)}
    for camera in correction.cameras:
        model = rig.cameras[camera].model
        names = [f"cameras.{camera}.{part}" for part in parameter_names(model.kind)]
        mine = [i for i, name in enumerate(names) if name in at]
        rows = [at[names[i]] for i in mine]
        step, turn = _moved_parameters(model, correction)
        per_step[rows] = step[mine]
        carried[np.ix_(rows, rows)] = turn[np.ix_(mine, mine)]
    by_residual = np.einsum("pi,inl->pnl", per_step, correction.gain)  # L K
    stays = carried - np.einsum("pnl,nlq->pq", by_residual, _parameter_rates(rig, known, correction))
    noise = correction.scale * correction.used.equations(correction.step).covariance_px2
    total = stays @ known.covariance @ stays.T + np.einsum("pnl,nlm,qnm->pq", by_residual, noise, by_residual)
    return RigCovariance(known.names, (total + total.T) / 2)


def _moved_parameters(model: CameraModel, correction: BodyPose) -> tuple[FloatArray, FloatArray]:
    """A camera's parameters' rates to the step (p, 6), and what its errors turn into by the motion (p, p)."""
    moved = model.moved(correction.motion)
    rotation = correction.motion.rotation
    size = len(parameter_names(model.kind))
    rates, turn = np.zeros((size, 6)), np.eye(size)
    for letter in dict.fromkeys(model.kind):
        part = parameter_part(model.kind, letter)
        if letter in "RE":
            continue
        now: FloatArray = getattr(moved, letter)
        about = correction.origin_m + correction.step[3:] if letter == "C" else np.zeros(3)
        follows = rigid_rates(np.eye(3)[None], now[None], about)[0]
        if letter != "C":
            follows[:, 3:] = 0.0  # no place: it turns, and a shift leaves it
        if letter in "AO":
            on, before = tangents(now), tangents(getattr(model, letter))
            rates[part], turn[part, part] = on @ follows, on @ rotation @ before.T
        else:
            rates[part], turn[part, part] = follows, rotation
    return rates, turn


def _parameter_rates(rig: Rig, known: RigCovariance, correction: BodyPose) -> FloatArray:
    """(n, 2k, p): predicted pixels' rates to the rig's parameters, those of the source pair included."""
    used, equations = correction.used, correction.used.equations(np.zeros(6))
    count, eyes = used.seen.shape
    rates = np.zeros((count, eyes, 2, len(known.names)))
    for eye, name in enumerate(used.cameras):
        on = used.seen[:, eye]
        rates[on, eye] = pixel_rates(rig, known.names, name, 0.0, 0.0, used.positions_m[on])[1]
    flat = rates.reshape(count, 2 * eyes, -1)
    for i, one in enumerate(used.handoffs):
        joints = (one.joints.pan_rad, one.joints.tilt_rad)
        clicked = click_rates(rig, known.names, one.pair, *joints, used.positions_m[i])
        flat[i] += equations.point_rates[i] @ used.rates_m_per_px[i] @ clicked
    return flat
