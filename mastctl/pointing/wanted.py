"""A request judged against the mast file before anything moves: is there such a camera, pixel, frame?"""

from __future__ import annotations

import numpy as np

from calib.mast.rig import Rig
from calib.rigid import FloatArray
from mastctl.pointing.requests import Aim, PixelTarget, PointingError, PointRequest, PositionTarget

FRAMES_KNOWN = ("rover", "site")


def aim_of(request: PointRequest, rig: Rig) -> Aim:
    """Return the request's aim, or the default where it names none.

    Raises
    ------
    PointingError
        ``unknown_camera``, ``bad_aim`` (a camera that does not turn with the head), ``outside_image``.
    """
    aim = request.aim
    if aim is None:
        clicked = [request.target.camera] if isinstance(request.target, PixelTarget) else []
        lefts = [left for left, _ in rig.stereo.values()]
        for name in [*clicked, *lefts, *rig.cameras]:
            if name in rig.cameras and rig.cameras[name].on == "head":
                x, y = rig.cameras[name].model.image_center_px
                return Aim(name, x, y)
        words = "no camera on the head is configured to aim with; only joint angles can be pointed at"
        raise PointingError("bad_aim", words)
    camera = rig.cameras.get(aim.camera)
    if camera is None:
        raise PointingError("unknown_camera", f"aim.camera {aim.camera[:80]} is not configured")
    if camera.on != "head":
        raise PointingError("bad_aim", f"aim.camera: {aim.camera} is on the rover's body and cannot be aimed")
    _inside(rig, aim.camera, aim.x_px, aim.y_px, "aim")
    return aim


def clicked_px(target: PixelTarget, rig: Rig) -> FloatArray:
    """Return the clicked pixel (2,), checked. Raises PointingError."""
    if target.camera not in rig.cameras:
        raise PointingError("unknown_camera", f"camera {target.camera[:80]} is not configured")
    _inside(rig, target.camera, target.x_px, target.y_px, "pixel")
    return np.array([target.x_px, target.y_px])


def position_in_rover_m(target: PositionTarget) -> FloatArray:
    """Return a position target (3,) as it stands, checked. Raises PointingError.

    Who knows the rover's pose carries a ``site`` position to the rover frame first; without one they are one.
    """
    if target.frame not in FRAMES_KNOWN:
        words = f"frame is {target.frame[:80]} where rover or site is expected"
        raise PointingError("bad_request", words)
    position = np.array(target.position_m, dtype=np.float64)
    if position.shape != (3,) or not np.isfinite(position).all():
        words = f"position_m is {target.position_m} where 3 finite numbers are expected"
        raise PointingError("bad_request", words)
    return position


def check_pointings(request: PointRequest) -> None:
    """Pass 1, and 2 where a second one can do something. Raises PointingError."""
    if request.pointings not in (1, 2):
        raise PointingError("bad_request", f"pointings is {request.pointings} where 1 or 2 is expected")
    if request.pointings == 2 and not isinstance(request.target, PixelTarget):
        raise PointingError(
            "bad_request",
            "a second pointing measures a clicked target again: it goes with a pixel, not with "
            "a position or joint angles",
        )


def _inside(rig: Rig, camera: str, x_px: float, y_px: float, what: str) -> None:
    """Pass a pixel of the camera's image."""
    model = rig.cameras[camera].model
    if not model.holds((x_px, y_px)):
        width, height = model.size_px
        words = f"{what}: pixel ({x_px:g}, {y_px:g}) is outside the {width}x{height} px of {camera}"
        raise PointingError("outside_image", words)
