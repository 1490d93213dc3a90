"""What may be pointed at, and a request judged before anything moves."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from calib.geometry.rig import Rig
from mastctl.devices.frames import StampedFrame, check_known
from mastctl.errors import BadRequest, NotNow

CHECKED = ConfigDict(extra="forbid", allow_inf_nan=False)
"""Unknown keys and numbers that are not finite are refused, and by the types below what only looks right."""
LARGEST_PX = 1e5
LARGEST_M = 1e6

Name = Annotated[str, Field(strict=True, min_length=1, max_length=200)]
Pixel = Annotated[float, Field(strict=True, ge=-LARGEST_PX, le=LARGEST_PX)]
Metres = Annotated[float, Field(strict=True, ge=-LARGEST_M, le=LARGEST_M)]
Angle = Annotated[float, Field(strict=True, ge=-2 * math.pi, le=2 * math.pi)]
Coordinate = Annotated[float, Field(strict=True)]  # a bounded position, carried on by a bounded pose
Range = Annotated[float, Field(strict=True, ge=0.01, le=1e5)]
Pointings = Annotated[int, Field(strict=True, ge=1, le=2)]


@dataclass(frozen=True, config=CHECKED)
class PixelTarget:
    """What a pixel of a named frame shows; ``mast_digest`` may say by which mast file it was taken."""

    camera: Name
    frame_id: Name
    x_px: Pixel
    y_px: Pixel
    mast_digest: Name | None = None


@dataclass(frozen=True, config=CHECKED)
class PositionTarget:
    """A point (3,), metres, in the ``rover`` or ``site`` frame; the two are one before the first pose."""

    position_m: tuple[Coordinate, Coordinate, Coordinate]
    frame: Literal["rover", "site"] = "rover"


@dataclass(frozen=True, config=CHECKED)
class AnglesTarget:
    """Joint angles, radians."""

    pan_rad: Angle
    tilt_rad: Angle


@dataclass(frozen=True, config=CHECKED)
class PlaneTarget:
    """A plane of the rover frame in which a clicked thing lies: a point (3,), metres, and its normal (3,).

    The normal's length and sign do not matter; by default the plane is level.
    """

    point_m: tuple[Metres, Metres, Metres]
    normal: tuple[Metres, Metres, Metres] = (0.0, 0.0, -1.0)

    def __post_init__(self) -> None:
        if not math.hypot(*self.normal) > 1e-9:
            raise ValueError("normal has no direction; expected a vector at right angles to the plane")


Target = PixelTarget | PositionTarget | AnglesTarget


@dataclass(frozen=True, config=CHECKED)
class Aim:
    """The pixel of a head camera on which the target is wanted."""

    camera: Name
    x_px: Pixel
    y_px: Pixel


@dataclass(frozen=True, config=CHECKED)
class PointRequest:
    """Point at a target.

    Attributes
    ----------
    target
        A pixel of a named frame, a position, or joint angles.
    aim
        Where the target is wanted; by default the image centre of the clicked camera if it is on the head,
        else of the first stereo pair's left camera on the head.
    pointings
        How often to point, 1 or 2: a second one uses what the new pictures showed.
    range_m
        How far what a pixel shows is from its camera; then no other eye is asked. None: it is measured by
        the pair, or not known where the camera is in none.
    plane
        Or the plane in which it lies.

    Raises
    ------
    ValueError
        If it is none (pydantic's, with place and value), or parts of it do not go together.
    """

    target: Target
    aim: Aim | None = None
    pointings: Pointings = 1
    range_m: Range | None = None
    plane: PlaneTarget | None = None

    def __post_init__(self) -> None:
        if self.aim is not None and isinstance(self.target, AnglesTarget):
            raise ValueError("aim goes with pixel or position_m, not with joint angles")
        for name, given in (("range_m", self.range_m), ("plane", self.plane)):
            if given is not None and not isinstance(self.target, PixelTarget):
                raise ValueError(f"{name} goes with pixel only")
        if self.range_m is not None and self.plane is not None:
            raise ValueError("range_m and plane both say how far it is; one of them is expected")
        if self.pointings == 2 and not isinstance(self.target, PixelTarget):
            raise ValueError("pointings is 2, which goes with pixel only: nothing else can be measured again")


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
        words = f"the head moved while this image of {camera} was exposed; take another"
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
            words = f"the other camera of the stereo pair {pair}, {other}, is not in the configuration"
    raise BadRequest("no_stereo", f"{words}, so what its pixels show cannot be followed")


def _check_inside(rig: Rig, camera: str, x_px: float, y_px: float, what: str) -> None:
    """Pass a pixel of the camera's image. Raises BadRequest."""
    model = rig.cameras[camera].model
    if not model.holds((x_px, y_px)):
        width, height = model.size_px
        words = f"{what} ({x_px:g}, {y_px:g}) is outside the image of {width}x{height} px of {camera}"
        raise BadRequest("outside_image", words)
