"""What a pointing's residual is expected to be: how it depends on all that may be wrong, to first order.

With e what the rig's parameters are wrong by, the pair's clicks put the target wrong by its own rates times
e, and the aimed camera sees both that and its own error (the chain of `calib.geometry.handoff`, with the
joints turned in between). What pair and aimed camera share cancels here as it does in the rig.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import JOINT_NAMES, click_rates, pixel_rates
from calib.geometry.parameters import parameter_names, parameter_part
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, ReadOnlyArrays, tangents
from mastctl.health.measured import Measured

CLICK_SIGMA_PX = 0.1
"""One sigma of a match in each eye of the pair."""
UNMODELLED_PX = 0.1
"""What no camera model describes and no match knows of, one sigma: another at each place of an image."""


@dataclass(frozen=True, eq=False)
class Expected(ReadOnlyArrays):
    """A pointing's residual by what it depends on.

    Attributes
    ----------
    noise_px2
        (2, 2) what differs from pointing to pointing: matches, counts.
    rates
        (2, p) by each of the rig's parameters that were asked for.
    turned
        (2, 3 c) px/rad by a turn of each of the cameras that were asked for about x, y and z of the frame
        that it is mounted on.
    """

    noise_px2: FloatArray
    rates: FloatArray
    turned: FloatArray


def expected(rig: Rig, parameters: Sequence[str], cameras: Sequence[str], one: Measured) -> Expected:
    """Return what a pointing's residual depends on.

    Parameters
    ----------
    rig
        The mast file in use.
    parameters
        (p,) names, as `calib.geometry.covariance` has them.
    cameras
        (c,) whose turns are of interest.
    one
        The pointing.

    Raises
    ------
    CalibError
        If the rig lacks a camera of it, or cannot have seen the target so.
    """
    pair, eyes = (one.source, one.partner), {one.source, one.partner, one.camera}
    if missing := eyes - set(rig.cameras):
        raise CalibError(f"the mast file has no camera {min(missing)}")
    known = set(parameters)
    free = [
        f"cameras.{name}.{part}" for name in eyes for part in parameter_names(rig.cameras[name].model.kind)
    ]
    names = (*parameters, *(name for name in free if name not in known), *JOINT_NAMES)
    point = np.array(one.position_m)
    there = _rates_of_position(rig, pair, one.from_rad, point)
    by_click = rig.camera_in_rover(one.camera, *one.to_rad).project_jacobian(point)[1] @ there
    before = by_click @ click_rates(rig, names, pair, *one.from_rad, point)
    after = pixel_rates(rig, names, one.camera, *one.to_rad, point[None])[1][0]
    joints = np.concatenate([before[:, -2:], after[:, -2:]], axis=1)
    sigma_rad = np.array(2 * one.count_rad) / math.sqrt(12.0)
    noise = (
        np.diag(np.square(one.match_sigma_px) + UNMODELLED_PX**2) + CLICK_SIGMA_PX**2 * by_click @ by_click.T
    )
    noise = noise + (joints * sigma_rad) @ (joints * sigma_rad).T
    rates = before + after
    if not (np.isfinite(rates).all() and np.isfinite(noise).all()):
        raise CalibError("the target of the pointing is nowhere that its cameras see")
    at = {name: i for i, name in enumerate(names)}
    turned = np.zeros((2, 3 * len(cameras)))
    for number, camera in enumerate(cameras):
        if camera in eyes:
            model = rig.cameras[camera].model
            mine = [at[f"cameras.{camera}.{part}"] for part in parameter_names(model.kind)]
            turned[:, 3 * number : 3 * number + 3] = rates[:, mine] @ _turn_rates(model)
    return Expected(noise, rates[:, : len(parameters)], turned)


def _rates_of_position(
    rig: Rig, pair: tuple[str, str], joints_rad: tuple[float, float], point_m: FloatArray
) -> FloatArray:
    """(3, 4) metres that a pair's point moves by for a pixel of each click."""
    views = [rig.camera_in_rover(name, *joints_rad).project_jacobian(point_m)[1] for name in pair]
    pixels = np.concatenate(views)
    if not np.isfinite(pixels).all():
        raise CalibError("the pair cannot have seen the target of the pointing")
    return np.asarray(np.linalg.pinv(pixels))


def _turn_rates(model: CameraModel) -> FloatArray:
    """(p, 3) of a camera's parameters to a turn about its own place, by the axes of the model's frame."""
    rates = np.zeros((len(parameter_names(model.kind)), 3))
    for letter in dict.fromkeys(model.kind):
        if letter in "CRE":
            continue
        x, y, z = getattr(model, letter)
        follows = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])  # of turn x letter
        if letter in "AO":
            follows = tangents(getattr(model, letter)) @ follows
        rates[parameter_part(model.kind, letter)] = follows
    return rates
