"""The bodies and queries that the API takes, and how it says what is wrong with one."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from calib.formats.strict import nearest
from mastctl.pointing.requests import Aim, AnglesTarget, PixelTarget, PointRequest, PositionTarget

LARGEST_PX = 1e5
LARGEST_M = 1e6

Name = Annotated[str, Field(min_length=1, max_length=200)]
Pixel = Annotated[float, Field(ge=-LARGEST_PX, le=LARGEST_PX)]
Metres = Annotated[float, Field(ge=-LARGEST_M, le=LARGEST_M)]
Angle = Annotated[float, Field(ge=-2 * math.pi, le=2 * math.pi)]


class _Strict(BaseModel):
    """Unknown keys, wrong types and numbers that are not finite are refused."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


class PixelBody(_Strict):
    """A pixel of a named frame; ``mast_digest`` may say by which mast file it was taken."""

    camera: Name
    frame_id: Name
    x_px: Pixel
    y_px: Pixel
    mast_digest: Name | None = None


class AimBody(_Strict):
    """Where in which camera's image the target shall come."""

    camera: Name
    x_px: Pixel
    y_px: Pixel


class PointBody(_Strict):
    """``POST /point``: exactly one of pixel, position_m, or pan_rad with tilt_rad."""

    pixel: PixelBody | None = None
    position_m: Annotated[list[Metres], Field(min_length=3, max_length=3)] | None = None
    frame: Literal["rover", "site"] | None = None
    pan_rad: Angle | None = None
    tilt_rad: Angle | None = None
    aim: AimBody | None = None
    pointings: Annotated[int, Field(ge=1, le=2)] = 1

    @model_validator(mode="after")
    def _one_target(self) -> PointBody:
        angles = (self.pan_rad is not None) + (self.tilt_rad is not None)
        targets = (self.pixel is not None) + (self.position_m is not None) + (angles > 0)
        if targets != 1:
            raise ValueError(
                f"{targets} targets where exactly one of pixel, position_m, pan_rad with tilt_rad is expected"
            )
        if angles == 1:
            missing = "tilt_rad" if self.tilt_rad is None else "pan_rad"
            raise ValueError(f"{missing} is missing; pan_rad and tilt_rad go together")
        if self.frame is not None and self.position_m is None:
            raise ValueError("frame goes with position_m only")
        if self.aim is not None and angles:
            raise ValueError("aim goes with pixel or position_m, not with joint angles")
        if self.pointings == 2 and self.pixel is None:
            raise ValueError("pointings is 2, which goes with pixel only: nothing else can be measured again")
        return self

    def request(self) -> PointRequest:
        """Return it as the pointing loop takes it."""
        aim = None if self.aim is None else Aim(self.aim.camera, self.aim.x_px, self.aim.y_px)
        target: PixelTarget | PositionTarget | AnglesTarget
        if self.pixel is not None:
            pixel = self.pixel
            target = PixelTarget(pixel.camera, pixel.frame_id, pixel.x_px, pixel.y_px)
        elif self.position_m is not None:
            x, y, z = self.position_m
            target = PositionTarget((x, y, z), self.frame or "rover")
        else:
            assert self.pan_rad is not None and self.tilt_rad is not None
            target = AnglesTarget(self.pan_rad, self.tilt_rad)
        return PointRequest(target=target, aim=aim, pointings=self.pointings)


class MastBody(_Strict):
    """``POST /mast``: the name of a file beside the configured mast file, or ``previous``: true."""

    file: Name | None = None
    previous: bool = False

    @model_validator(mode="after")
    def _one(self) -> MastBody:
        if (self.file is not None) == self.previous:
            raise ValueError("file, or previous: true, is expected, and not both")
        return self


class FaultBody(_Strict):
    """``POST /simulation/faults``: a fault word for a simulated device, with its parameters."""

    device: Name
    word: Name
    parameters: dict[str, float] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _free_names(self) -> FaultBody:
        for name in ("device", "word", "self"):
            if name in self.parameters:
                raise ValueError(f"parameters.{name}: unknown key; no fault has a parameter of this name")
        return self


class SnapshotQuery(BaseModel):
    """``GET /snapshot/{camera}``; ``frame_id`` asks for a frame that is still kept."""

    model_config = ConfigDict(extra="forbid")

    format: Literal["png", "jpeg"] = "png"
    fresh: bool = False
    frame_id: Name | None = None


class FaultsQuery(BaseModel):
    """``DELETE /simulation/faults``; without a device all faults are taken back."""

    model_config = ConfigDict(extra="forbid")

    device: Name | None = None


class ErrorTold(BaseModel):
    """Why a request was refused: a word for programs, a sentence for people, more where there is more."""

    code: str
    message: str
    detail: dict[str, Any] | None = None


class ErrorBody(BaseModel):
    """Every answer that is not a success."""

    error: ErrorTold


_KEYS: Mapping[tuple[str, ...], Sequence[str]] = {
    ("body", "pixel"): tuple(PixelBody.model_fields),
    ("body", "aim"): tuple(AimBody.model_fields),
}
_ROUTE_KEYS: Mapping[tuple[str, str], Sequence[str]] = {
    ("body", "point"): tuple(PointBody.model_fields),
    ("body", "mast"): tuple(MastBody.model_fields),
    ("body", "faults"): tuple(FaultBody.model_fields),
    ("query", "snapshot"): tuple(SnapshotQuery.model_fields),
    ("query", "faults"): tuple(FaultsQuery.model_fields),
}


def sentence(problem: Mapping[str, Any], route: str) -> str:
    """Return one validation problem of pydantic as a plain sentence: place, value, what is expected.

    Parameters
    ----------
    problem
        One entry of pydantic's list of errors.
    route
        A word that names the route (``point``, ``snapshot``, ``faults``), for the keys it knows.
    """
    where = tuple(str(step) for step in problem["loc"])
    place = _place(where)
    kind = problem["type"]
    words = str(problem["msg"])
    if kind == "value_error":
        return words.removeprefix("Value error, ")
    if kind == "missing":
        return f"{place} is missing" if len(where) > 1 else "the body is missing; a JSON object is expected"
    if kind == "extra_forbidden":
        known = _KEYS.get(where[:-1]) or _ROUTE_KEYS.get((where[0], route)) or ()
        return f"{place}: unknown key; {nearest(where[-1], known)}" if known else f"{place}: unknown key"
    value = _short(problem.get("input"))
    if kind in ("too_short", "too_long"):
        return f"{place}: {value} where a list of 3 numbers is expected"
    if kind in ("model_attributes_type", "model_type", "dict_type"):
        return f"{place}: {value} where an object with keys is expected"
    for start in ("Input should be ", "String should have "):
        if words.startswith(start):
            return f"{place}: {value} where {words.removeprefix(start)} is expected"
    return f"{place}: {value}: {words}"


def _place(where: tuple[str, ...]) -> str:
    """``("body", "position_m", "0")`` as ``position_m[0]``."""
    place = ""
    for step in where[1:]:
        place += f"[{step}]" if step.isdecimal() else f".{step}" if place else step
    return place[:120] or f"the {where[0]}"


def _short(value: Any) -> str:
    """A value as JSON, cut short."""
    try:
        text = json.dumps(value)
    except (TypeError, ValueError):
        text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
