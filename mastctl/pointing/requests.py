"""What the pointing loop and the tracker are asked: checked when it is made, whoever makes it.

What is checked here needs no rig: types, finite numbers, bounds, what goes with what. Whether there is such
a camera, frame or pixel is judged by `mastctl.pointing.wanted`.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

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
