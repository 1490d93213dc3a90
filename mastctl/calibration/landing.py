"""Where a target lands when a rig is believed that is not quite the true one, and how sure that is over the
joints.

What the daemon does with a click: two pixels of a stereo pair, triangulated and pointed at by the believed
rig. What happens then is by the true one. The paper's sections IV and V, without a renderer.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from calib.adjust.result import Calibration
from calib.adjust.uncertainty import pixel_covariance, pointing_covariance
from calib.errors import CalibError
from calib.geometry.pointing import solve
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.geometry.stereo import triangulate


def click(
    true: Rig, pair: tuple[str, str], pan_rad: float, tilt_rad: float, left_px: ArrayLike, range_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a target (3,), rover frame, metres, and its true pixels (2,) in the left and right image.

    The target is ``range_m`` along the true ray of ``left_px`` at the given joint angles.

    Raises
    ------
    CalibError
        If one of the two cameras does not see it.
    """
    rays = true.camera_in_rover(pair[0], pan_rad, tilt_rad).ray(left_px)
    target = rays.origins_m + range_m * rays.directions
    left, right = (seen(true, name, pan_rad, tilt_rad, target) for name in pair)
    return target, left, right


def seen(rig: Rig, camera: str, pan_rad: float, tilt_rad: float, point_m: FloatArray) -> FloatArray:
    """Return the pixel (2,) of a rover-frame point (3,), metres, inside or outside the image.

    Raises
    ------
    CalibError
        If the camera cannot project it.
    """
    pixel, valid = rig.camera_in_rover(camera, pan_rad, tilt_rad).project(point_m)
    if not valid:
        raise CalibError(f"camera {camera} does not see the point {np.round(point_m, 3).tolist()} m")
    return np.asarray(pixel)


def pointing_error_px(
    believed: Rig,
    true: Rig,
    pair: tuple[str, str],
    pan_rad: float,
    tilt_rad: float,
    target_m: FloatArray,
    left_px: ArrayLike,
    right_px: ArrayLike,
) -> FloatArray:
    """Return how far (2,), pixels, a target lands from the middle of the left image after one pointing.

    Parameters
    ----------
    believed, true
        The rig that computes, and the rig that moves.
    pan_rad, tilt_rad
        Joint angles at which the target was clicked.
    target_m
        Where the target is, rover frame (3,).
    left_px, right_px
        The clicks (2,).

    Raises
    ------
    CalibError
        If the believed rig finds no such point, or cannot point at it.
    """
    left, right = (believed.camera_in_rover(name, pan_rad, tilt_rad) for name in pair)
    found = triangulate(left, right, left_px, right_px)
    return position_error_px(believed, true, pair[0], pan_rad, tilt_rad, found.position_m, target_m)


def position_error_px(
    believed: Rig,
    true: Rig,
    camera: str,
    pan_rad: float,
    tilt_rad: float,
    position_m: FloatArray,
    target_m: FloatArray,
) -> FloatArray:
    """Return how far (2,), pixels, a target lands from the image's middle if ``position_m`` is pointed at.

    ``pan_rad``, ``tilt_rad`` choose the nearest of several solutions. Raises CalibError as above.
    """
    model = believed.cameras[camera].model
    middle = np.array(model.image_center_px)
    angles = solve(
        believed.mast, model, position_m, middle, from_pan_rad=pan_rad, from_tilt_rad=tilt_rad
    )[0]  # fmt: skip
    return np.asarray(seen(true, camera, angles.pan_rad, angles.tilt_rad, target_m) - middle)


def handoff_errors_px(
    believed: Rig,
    true: Rig,
    pair: tuple[str, str],
    to: tuple[str, ...],
    pan_rad: float,
    tilt_rad: float,
    target_m: FloatArray,
    left_px: ArrayLike,
    right_px: ArrayLike,
) -> Mapping[str, FloatArray]:
    """Return by camera how far (2,), pixels, a hand-off puts a target from where it truly is.

    Cameras of ``to`` whose image does not hold the target are left out. Raises CalibError as above.
    """
    left, right = (believed.camera_in_rover(name, pan_rad, tilt_rad) for name in pair)
    position = triangulate(left, right, left_px, right_px).position_m
    errors = {}
    for name in to:
        pixel, valid = true.camera_in_rover(name, pan_rad, tilt_rad).project(target_m)
        if valid and true.cameras[name].model.holds(pixel):
            errors[name] = seen(believed, name, pan_rad, tilt_rad, position) - pixel
    return errors


PAN_RAD = (-2.6, 2.6)
TILT_RAD = (-1.2, 0.7)
STEPS = (27, 15)

CORNER = (0.2, 0.25)
"""Where a click is taken to be, as part of the image's width and height: off the middle."""


@dataclass(frozen=True, eq=False)
class PointingMap:
    """Pixels over pan (n,) and tilt (m,), radians: ``by_click`` and ``by_position`` (m, n).

    ``by_click``: a target clicked in the stereo pair at these joint angles; it is the same at every pan,
    since all of it happens beyond the pan axis. ``by_position``: a target whose place in the rover frame is
    given. Not-a-number where there is no answer.
    """

    pair: str
    camera: str
    range_m: float
    pan_rad: FloatArray
    tilt_rad: FloatArray
    by_click: FloatArray
    by_position: FloatArray


def uncertainty_map(calibration: Calibration, pair: str, range_m: float) -> PointingMap:
    """Return the sigma (rms per axis, px) that the calibration alone gives to pointing, over the joints."""
    names = calibration.rig.stereo[pair]
    middle = np.array(calibration.rig.cameras[names[0]].model.image_center_px)
    corner = _corner(calibration.rig, names[0])

    def by_click(tilt: float) -> float:
        return _rms(pointing_covariance(calibration, names, 0.0, tilt, corner, range_m))

    def by_position(pan: float, tilt: float) -> float:
        rays = calibration.rig.camera_in_rover(names[0], pan, tilt).ray(middle)
        target = rays.origins_m + range_m * rays.directions
        return _rms(pixel_covariance(calibration, names[0], pan, tilt, target[None])[1][0])

    return _map(pair, names[0], range_m, by_click, by_position)


def change_map(new: Rig, old: Rig, pair: str, range_m: float) -> PointingMap | None:
    """Return by how many pixels pointing would change (length of the shift), over the joints.

    The new rig is taken as true. None where the old rig has no such cameras on its head.
    """
    names = new.stereo[pair]
    if any(name not in old.cameras or old.cameras[name].on != "head" for name in names):
        return None
    middle = np.array(new.cameras[names[0]].model.image_center_px)

    def by_click(tilt: float) -> float:
        target, left, right = click(new, names, 0.0, tilt, _corner(new, names[0]), range_m)
        return float(np.linalg.norm(pointing_error_px(old, new, names, 0.0, tilt, target, left, right)))

    def by_position(pan: float, tilt: float) -> float:
        rays = new.camera_in_rover(names[0], pan, tilt).ray(middle)
        target = rays.origins_m + range_m * rays.directions
        return float(np.linalg.norm(position_error_px(old, new, names[0], pan, tilt, target, target)))

    return _map(pair, names[0], range_m, by_click, by_position)


def _map(
    pair: str,
    camera: str,
    range_m: float,
    by_click: Callable[[float], float],
    by_position: Callable[[float, float], float],
) -> PointingMap:
    pans, tilts = np.linspace(*PAN_RAD, STEPS[0]), np.linspace(*TILT_RAD, STEPS[1])
    clicked = np.array([_or_nan(by_click, float(tilt)) for tilt in tilts])
    placed = np.array([[_or_nan(by_position, float(pan), float(tilt)) for pan in pans] for tilt in tilts])
    return PointingMap(pair, camera, range_m, pans, tilts, np.tile(clicked[:, None], len(pans)), placed)


def _or_nan(value: Callable[..., float], *joints_rad: float) -> float:
    try:
        return value(*joints_rad)
    except CalibError:
        return float("nan")


def _corner(rig: Rig, camera: str) -> FloatArray:
    width, height = rig.cameras[camera].model.size_px
    return np.array([CORNER[0] * width, CORNER[1] * height])


def _rms(covariance: FloatArray) -> float:
    return float(np.sqrt(np.trace(covariance) / 2))
