"""Where a target lands when a rig is believed that is not quite the true one.

What the daemon does with a click: two pixels of a stereo pair, triangulated and pointed at by the believed
rig. What happens then is by the true one. The paper's sections IV and V, without a renderer.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

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
