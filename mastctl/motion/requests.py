"""What may be pointed at or followed, a request judged before anything moves, and how one fails."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

from calib.geometry.rig import Rig
from calib.geometry.rigid import Rigid
from mastctl.answers import PointingResult
from mastctl.devices.frames import StampedFrame, check_known
from mastctl.errors import BadRequest, MastctlError, NotNow

CHECKED = ConfigDict(extra="forbid", allow_inf_nan=False)
"""Unknown keys and numbers that are not finite are refused, and by the types below what only looks right."""
LARGEST_PX = 1e5
LARGEST_M = 1e6
LONGEST_DEADLINE_S = 3600.0

Name = Annotated[str, Field(strict=True, min_length=1, max_length=200)]
Pixel = Annotated[float, Field(strict=True, ge=-LARGEST_PX, le=LARGEST_PX)]
Metres = Annotated[float, Field(strict=True, ge=-LARGEST_M, le=LARGEST_M)]
Place = Annotated[list[Metres], Field(min_length=3, max_length=3)]
Angle = Annotated[float, Field(strict=True, ge=-2 * math.pi, le=2 * math.pi)]
Range = Annotated[float, Field(strict=True, ge=0.01, le=1e5)]
Pointings = Annotated[int, Field(strict=True, ge=1, le=2)]
DeadlineS = Annotated[float, Field(gt=0.0, le=LONGEST_DEADLINE_S, allow_inf_nan=False)]


class PointingError(MastctlError):
    """The request failed; the daemon stopped the mast.

    ``code`` is its own, or that of what ended it. Of a search for the target that found none: ``target_flat``
    (too little texture, or along one direction only), ``target_ambiguous`` (a second place fits nearly as
    well), ``target_border`` (at the border of an image or of the search window), ``target_not_found``
    (hidden, changed, or at another range). ``step`` failed, ``result`` has the pointings done before it.
    """

    def __init__(self, code: str, message: str, step: str = "", result: PointingResult | None = None) -> None:
        self.code = code
        self.step = step
        self.result = result
        super().__init__(message)

    @property
    def detail(self) -> dict[str, str]:
        """The failed step, for the error's detail."""
        return {"step": self.step}


class StrictBody(BaseModel):
    """Unknown keys, wrong types and numbers that are not finite are refused."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


@dataclass(frozen=True, config=CHECKED)
class PixelTarget:
    """What a pixel of a named frame shows; ``mast_digest`` may say by which mast file it was taken."""

    camera: Name
    frame_id: Name
    x_px: Pixel
    y_px: Pixel
    mast_digest: Name | None = None


@dataclass(frozen=True, config=CHECKED)
class PanoramaTarget:
    """What a pixel of a panorama's mosaic shows, or with ``view`` one of that view's picture.

    ``recompute``: evaluate a panorama of another mast file through its angles as read; ``by_direction``:
    point where the panorama's surface puts it, with nothing found again in a picture.
    """

    id: Name
    x_px: Pixel
    y_px: Pixel
    view: Annotated[int, Field(strict=True, ge=0, le=1_000_000)] | None = None
    recompute: bool = False
    by_direction: bool = False


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


@dataclass(frozen=True, config=CHECKED)
class Aim:
    """The pixel of a head camera on which the target is wanted."""

    camera: Name
    x_px: Pixel
    y_px: Pixel


class TrackRequest(StrictBody):
    """``POST /track``: exactly one of pixel and position_m, (3,) in the ``rover`` (default) or ``site``."""

    deadline_s: DeadlineS | None = None
    pixel: PixelTarget | None = None
    position_m: Place | None = None
    frame: Literal["rover", "site"] | None = None

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if self.frame is not None and self.position_m is None:
            raise ValueError("frame goes with position_m only")
        self._check_targets()
        return self

    def _check_targets(self) -> None:
        """Pass exactly one target. Raises ValueError."""
        if (self.pixel is None) == (self.position_m is None):
            raise ValueError("exactly one of pixel and position_m is expected")

    def in_rover(self, site_from_rover: Rigid) -> Self:
        """Return it with a position of the site in the rover frame."""
        if self.frame != "site":
            return self
        place = site_from_rover.inverse.points(np.array(self.position_m)).tolist()
        return self.model_copy(update={"position_m": place, "frame": "rover"})


class PointRequest(TrackRequest):
    """``POST /point``: exactly one of pixel, panorama, position_m, or pan_rad with tilt_rad.

    ``aim`` is where the target is wanted; by default the image centre of the clicked camera if it is on the
    head, else of the first stereo pair's left camera on the head. A second of the ``pointings`` uses what the
    new images showed. ``range_m`` is how far what a pixel shows is from its camera, or ``plane`` the one in
    which it lies: then no other camera is needed. Without them a pair measures it, or it is not known.
    """

    panorama: PanoramaTarget | None = None
    pan_rad: Angle | None = None
    tilt_rad: Angle | None = None
    aim: Aim | None = None
    pointings: Pointings = 1
    range_m: Range | None = None
    plane: PlaneTarget | None = None

    def _check_targets(self) -> None:
        """Pass exactly one target, and what goes with it. Raises ValueError."""
        angles = (self.pan_rad is not None) + (self.tilt_rad is not None)
        clicked = (self.pixel is not None) + (self.panorama is not None)
        targets = clicked + (self.position_m is not None) + (angles > 0)
        if targets != 1:
            raise ValueError(
                f"{targets} targets where exactly one of pixel, panorama, position_m, pan_rad with tilt_rad "
                "is expected"
            )
        if angles == 1:
            missing = "tilt_rad" if self.tilt_rad is None else "pan_rad"
            raise ValueError(f"{missing} is missing; pan_rad and tilt_rad go together")
        if self.aim is not None and angles:
            raise ValueError("aim goes with pixel or position_m, not with joint angles")
        for name, given in (("range_m", self.range_m), ("plane", self.plane)):
            if given is not None and self.pixel is None:
                raise ValueError(f"{name} goes with pixel only")
        if self.range_m is not None and self.plane is not None:
            raise ValueError("range_m and plane both say how far it is; one of them is expected")
        if self.pointings == 2 and not clicked:
            raise ValueError("pointings is 2, which goes with a pixel only: nothing else is measured again")

    @property
    def angles_rad(self) -> tuple[float, float] | None:
        """The joint angles, if these are the target."""
        return None if self.pan_rad is None or self.tilt_rad is None else (self.pan_rad, self.tilt_rad)

    @property
    def captures(self) -> int:
        """How often it goes somewhere and takes images there."""
        return 0 if self.angles_rad is not None else self.pointings + (self.panorama is not None)


def aim_of(request: PointRequest, rig: Rig) -> Aim:
    """Return the request's aim, or the default. Raises BadRequest ``bad_aim``, ``outside_image``."""
    aim = request.aim
    on_head = [name for name, camera in rig.cameras.items() if camera.on == "head"]
    if aim is None:
        clicked = [] if request.pixel is None else [request.pixel.camera]
        lefts = [left for left, _ in rig.stereo.values()]
        for name in [*clicked, *lefts, *on_head]:
            if name in on_head:
                return Aim(name, *rig.cameras[name].model.image_center_px)
        message = "no camera on the head is configured to aim with; only joint angles can be pointed at"
        raise BadRequest("bad_aim", message)
    if aim.camera not in on_head:
        known = ", ".join(on_head) or "there is none"
        message = f"'{aim.camera[:80]}' where a configured camera on the head is expected: {known}"
        raise BadRequest("bad_aim", f"aim.camera is {message}")
    _check_inside(rig, aim.camera, aim.x_px, aim.y_px, "aim")
    return aim


def clicked_frame(target: PixelTarget, rig: Rig, find: Callable[[str], StampedFrame]) -> StampedFrame:
    """Return the frame that was clicked in, by ``find``, if its camera, the pixel and its moment serve."""
    camera = target.camera
    check_known(camera, rig.cameras)
    frame = find(target.frame_id)
    if frame.camera != camera:
        raise wrong_camera(frame, camera)
    if frame.moving:
        message = f"the head moved while this image of {camera} was exposed; take another"
        raise NotNow("frame_moving", message)
    _check_inside(rig, camera, target.x_px, target.y_px, "pixel")
    return frame


def wrong_camera(frame: StampedFrame, camera: str) -> BadRequest:
    """Return the refusal of a frame that is of another camera than was said."""
    return BadRequest("wrong_camera", f"frame {frame.frame_id} is of camera {frame.camera}, not of {camera}")


def check_pair(camera: str, rig: Rig, mast_file: Rig) -> None:
    """Pass a camera whose stereo partner is in ``rig`` too. Raises BadRequest ``no_stereo``."""
    if any(camera in cameras for cameras in rig.stereo.values()):
        return
    reason = f"{camera} is in no stereo pair of the mast file"
    for pair, cameras in mast_file.stereo.items():
        if camera in cameras:
            other = cameras[1] if camera == cameras[0] else cameras[0]
            reason = f"the other camera of the stereo pair {pair}, {other}, is not in the configuration"
    raise BadRequest("no_stereo", f"{reason}, so what its pixels show cannot be followed")


def _check_inside(rig: Rig, camera: str, x_px: float, y_px: float, what: str) -> None:
    """Pass a pixel of the camera's image. Raises BadRequest."""
    model = rig.cameras[camera].model
    if not model.holds((x_px, y_px)):
        width, height = model.size_px
        place = f"{what} ({x_px:g}, {y_px:g}) is outside the image of {width}x{height} px of {camera}"
        raise BadRequest("outside_image", place)
