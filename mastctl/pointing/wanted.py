"""A request judged before anything moves: is there such a camera, such a pixel, a frame that serves?"""

from __future__ import annotations

from collections.abc import Callable

from calib.mast.rig import Rig
from mastctl.devices.frames import StampedFrame, check_known
from mastctl.errors import BadRequest, NotNow
from mastctl.pointing.requests import Aim, PixelTarget, PointRequest


def aim_of(request: PointRequest, rig: Rig) -> Aim:
    """Return the request's aim, or the default where it names none.

    Raises
    ------
    BadRequest
        ``bad_aim`` (no camera that is configured and turns with the head), ``outside_image``.
    """
    aim = request.aim
    on_head = [name for name, camera in rig.cameras.items() if camera.on == "head"]
    if aim is None:
        clicked = [request.target.camera] if isinstance(request.target, PixelTarget) else []
        lefts = [left for left, _ in rig.stereo.values()]
        for name in [*clicked, *lefts, *on_head]:
            if name in on_head:
                return Aim(name, *rig.cameras[name].model.image_center_px)
        words = "no camera on the head is configured to aim with; only joint angles can be pointed at"
        raise BadRequest("bad_aim", words)
    if aim.camera not in on_head:
        known = ", ".join(on_head) or "there is none"
        words = f"'{aim.camera[:80]}' where a configured camera on the head is expected: {known}"
        raise BadRequest("bad_aim", f"aim.camera is {words}")
    _check_inside(rig, aim.camera, aim.x_px, aim.y_px, "aim")
    return aim


def clicked_frame(target: PixelTarget, rig: Rig, find: Callable[[str], StampedFrame]) -> StampedFrame:
    """Return the frame that was clicked in, if its camera, the pixel and its moment serve.

    Parameters
    ----------
    target
        What was clicked.
    rig
        The cameras that are configured.
    find
        Returns a kept frame by its id.

    Raises
    ------
    NotKnown, BadRequest, NotNow
        ``unknown_camera``, ``wrong_camera``, ``outside_image``, ``frame_moving``; whatever
        ``find`` raises.
    """
    camera = target.camera
    check_known(camera, rig.cameras)
    frame = find(target.frame_id)
    if frame.camera != camera:
        raise wrong_camera(frame, camera)
    if frame.moving:
        words = f"the head moved while frame {frame.frame_id} was exposed; take another"
        raise NotNow("frame_moving", words)
    _check_inside(rig, camera, target.x_px, target.y_px, "pixel")
    return frame


def wrong_camera(frame: StampedFrame, camera: str) -> BadRequest:
    """Return what is wrong with a frame that is of another camera than was said."""
    return BadRequest("wrong_camera", f"frame {frame.frame_id} is of camera {frame.camera}, not of {camera}")


def check_pair(camera: str, rig: Rig, mast_file: Rig) -> None:
    """Pass a camera whose other eye is configured too, as a track needs. Raises BadRequest ``no_stereo``.

    ``rig`` has the cameras that are configured, ``mast_file`` all.
    """
    if any(camera in eyes for eyes in rig.stereo.values()):
        return
    words = f"{camera} is in no stereo pair of the mast file"
    for pair, eyes in mast_file.stereo.items():
        if camera in eyes:
            other = eyes[1] if camera == eyes[0] else eyes[0]
            words = f"the other eye of the stereo pair {pair}, {other}, is not in the configuration"
    raise BadRequest("no_stereo", f"{words}, so what its pixels show cannot be followed")


def _check_inside(rig: Rig, camera: str, x_px: float, y_px: float, what: str) -> None:
    """Pass a pixel of the camera's image. Raises BadRequest."""
    model = rig.cameras[camera].model
    if not model.holds((x_px, y_px)):
        width, height = model.size_px
        words = f"{what} ({x_px:g}, {y_px:g}) is outside the image of {width}x{height} px of {camera}"
        raise BadRequest("outside_image", words)
