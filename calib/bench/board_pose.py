"""Where a board is, from one camera's picture of it and a rig that is known roughly."""

from __future__ import annotations

import cv2
import numpy as np

from calib.camera.difference import camera_axes
from calib.errors import CalibError
from calib.mast.rig import Rig
from calib.rigid import FloatArray, Rigid

FEWEST = 4


def rover_from_board(
    rig: Rig, camera: str, pan_rad: float, tilt_rad: float, in_board_m: FloatArray, pixels_px: FloatArray
) -> Rigid:
    """Return the pose of a flat board in the rover frame.

    Parameters
    ----------
    rig, camera
        Who sees it.
    pan_rad, tilt_rad
        True joint angles, radians.
    in_board_m, pixels_px
        (n, 3) and (n, 2), at least four corners that are not in one line.

    Raises
    ------
    CalibError
        If they do not fix a pose in front of the camera.
    """
    held = rig.cameras[camera]
    model = held.model
    axes = camera_axes(model)
    rays = model.ray(pixels_px).directions @ axes
    if len(rays) < FEWEST:
        raise CalibError(f"{len(rays)} corners where {FEWEST} at least fix a board")
    flat = np.ascontiguousarray(rays[:, :2] / rays[:, 2:])
    try:
        done, turn, place = cv2.solvePnP(
            np.ascontiguousarray(in_board_m), flat, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:
        done = False
    if not done or not np.isfinite(place).all() or place[2, 0] <= 0.0:
        raise CalibError(f"the corners in the picture of {camera} fix no board")
    rotation = axes @ cv2.Rodrigues(turn)[0]
    here = Rigid(_right(rotation), axes @ place[:, 0] + model.C)
    return here if held.on == "rover" else rig.mast.rover_from_head(pan_rad, tilt_rad) @ here


def _right(rotation: FloatArray) -> FloatArray:
    """The nearest rotation."""
    left, _, right = np.linalg.svd(rotation)
    return np.asarray(left @ right)
