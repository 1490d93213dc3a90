"""What a configuration makes the scene of: ground, sun, rocks, bricks and boards, checked before it is built.

Places are in the site frame (x north, y east), which is the rover frame as long as the rover has not moved.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import combinations
from typing import Annotated, Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, model_validator

from calib.errors import BadFile
from calib.files.records import ABSENT, problem
from calib.geometry.rig import Rig
from calib.targets.board_file import board_of
from calib.targets.boards import AnyBoard, DotBoard
from drivers.errors import BadOptions
from drivers.options import DriverOptions, ReadBy, is_whole, read_options

Float64 = NDArray[np.float64]

REACH_M = 28.0
"""How far from the middle of the ground things may be placed, and the rover may stand, along x and y."""

MOST = {"rocks": 500, "bricks": 100, "boards": 24}
BOARD_M = 0.02  # thick
ROVER_M = 0.5  # from its origin nothing is placed nearer than this, or than its cameras reach
CLEAR_M = 0.05  # beyond the cameras' reach


class _Placed(DriverOptions):
    """A thing's place in the site frame."""

    x_m: Annotated[float, Field(ge=-REACH_M, le=REACH_M)]
    """North."""
    y_m: Annotated[float, Field(ge=-REACH_M, le=REACH_M)]
    """East."""


_Heading = Annotated[float, Field(ge=-2 * math.pi, le=2 * math.pi)]
_Side = Annotated[float, Field(ge=0.02, le=3.0)]


class PlacedRock(_Placed):
    """A stone: where, how wide, how it is turned; its shape is of the scene's seed and its place."""

    diameter_m: Annotated[float, Field(ge=0.03, le=3.0)] = 0.3
    heading_rad: _Heading = 0.0


class PlacedBrick(_Placed):
    """A box level on the ground; its length points along the heading."""

    heading_rad: _Heading = 0.0
    length_m: _Side = 0.39
    width_m: _Side = 0.19
    height_m: _Side = 0.19


class PlacedBoard(_Placed):
    """A board: the middle of its lower edge over (x, y), ``raised_m`` over the ground.

    Its face looks along the heading (by default towards the site's origin), ``lean_rad`` upwards. The print's
    own keys stand beside these in a configuration, as in a BOARD.yaml.
    """

    model_config = ConfigDict(arbitrary_types_allowed=True)

    heading_rad: _Heading = ABSENT
    lean_rad: Annotated[float, Field(ge=-1.0, le=1.0)] = 0.0
    raised_m: Annotated[float, Field(ge=0.0, le=3.0)] = 0.0
    margin_m: Annotated[float, Field(ge=0.0, le=1.0)] = 0.02
    """White paper around the print; around dots from the outer ones' middles."""
    board: AnyBoard

    @property
    def paper_m(self) -> float:
        """White paper around the print."""
        dot_m = self.board.dot_diameter_m if isinstance(self.board, DotBoard) else 0.0
        return self.margin_m - dot_m / 2

    @property
    def size_m(self) -> Float64:
        """Width and height with the white paper, (2,)."""
        return np.array(self.board.size_m) + 2 * self.paper_m

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.heading_rad is None:
            object.__setattr__(self, "heading_rad", math.atan2(-self.y_m, -self.x_m))
        if self.paper_m < 0:
            raise problem("margin_m", f"{self.margin_m:g} where half a dot at least is expected")
        width, height = self.size_m
        if not 0.05 <= max(width, height) <= 4.0:
            raise problem("", f"{width:g} x {height:g} m where 0.05 to 4 m is expected")
        return self


Placed = PlacedRock | PlacedBrick | PlacedBoard
PRINTS: Mapping[str, Mapping[str, Any]] = {
    "dots": {"rows": 10, "columns": 10, "spacing_m": 0.08, "dot_diameter_m": 0.04},
    "charuco": {
        "rows": 7, "columns": 10, "square_m": 0.08, "marker_m": 0.06, "dictionary": "DICT_5X5_100"
    },
}  # fmt: skip
"""What a board has where a configuration leaves it out, by its kind."""


def placed_or(kind: str, most: int = 0) -> ReadBy:
    """Return what annotates placed rocks, bricks or boards, or how many are scattered, up to ``most``."""

    def read(value: Any) -> int | tuple[Placed, ...]:
        key = f"simulation.scene.{kind}"
        if isinstance(value, list | tuple):
            if len(value) > MOST[kind]:
                raise BadOptions(f"{key} are {len(value)}, expected {MOST[kind]} at most")
            return tuple(_one(kind, one, f"{key}[{k}]") for k, one in enumerate(value))
        if not most or not is_whole(value) or not 0 <= value <= most:
            number = f"a number from 0 to {most} or " if most else ""
            raise BadOptions(f"{key} is {value!r}, expected {number}a list")
        return value

    return ReadBy(read)


def _one(kind: str, value: Any, key: str) -> Placed:
    if isinstance(value, PlacedRock | PlacedBrick | PlacedBoard):
        return value
    if not isinstance(value, Mapping):
        raise BadOptions(f"{key} is {value!r}, expected keys and values, as {{x_m: 5, y_m: 0}}")
    if kind == "rocks":
        return read_options(PlacedRock, value, place=key)
    if kind == "bricks":
        return read_options(PlacedBrick, value, place=key)
    own = {name: value[name] for name in PlacedBoard.model_fields if name in value and name != "board"}
    printed = {name: one for name, one in value.items() if name not in own}
    printed = {"kind": "dots", **PRINTS.get(str(printed.get("kind", "dots")), {}), **printed}
    if printed["kind"] == "dots":
        own.setdefault("margin_m", 0.08)
    try:
        return read_options(PlacedBoard, {**own, "board": board_of("", key, printed)}, place=key)
    except BadFile as error:
        raise BadOptions(f"{error.place}: {error.reason}") from None


def footprint_m(thing: Placed) -> Float64:
    """Return the outline (n, 2) of a thing from above, site frame."""
    middle = np.array([thing.x_m, thing.y_m])
    if isinstance(thing, PlacedRock):
        turn = np.linspace(0.0, 2 * np.pi, 16, endpoint=False)
        return middle + 0.5 * thing.diameter_m * np.column_stack([np.cos(turn), np.sin(turn)])
    ahead = np.array([math.cos(thing.heading_rad), math.sin(thing.heading_rad)])
    right = np.array([-ahead[1], ahead[0]])
    if isinstance(thing, PlacedBrick):
        front, back, aside = thing.length_m / 2, -thing.length_m / 2, thing.width_m / 2
    else:
        back_m = -thing.size_m[1] * math.sin(thing.lean_rad)  # of the upper edge
        front, back = max(0.0, back_m), min(0.0, back_m) - BOARD_M
        aside = thing.size_m[0] / 2
    ways = ((front, aside), (front, -aside), (back, -aside), (back, aside))
    return np.array([middle + along * ahead + across * right for along, across in ways])


def middle_m(thing: Placed) -> Float64:
    """Return the middle (2,) of a thing's outline."""
    return np.asarray(footprint_m(thing).mean(axis=0))


def radius_m(thing: Placed) -> float:
    """Return how far a thing's outline reaches from its middle."""
    return float(np.linalg.norm(footprint_m(thing) - middle_m(thing), axis=1).max())


def check_apart(things: Mapping[str, Placed]) -> None:
    """Raise BadOptions with the first pair of things of which one stands in the other."""
    outlines = {key: _hull(footprint_m(thing).astype(np.float32)) for key, thing in things.items()}
    for (other, before), (key, outline) in combinations(outlines.items(), 2):
        area_m2, _ = cv2.intersectConvexConvex(outline, before)
        if area_m2 > 1e-6:
            raise BadOptions(
                f"{key} at ({things[key].x_m:g}, {things[key].y_m:g}) m stands in {other} at "
                f"({things[other].x_m:g}, {things[other].y_m:g}) m, expected things apart from each other"
            )


def check_clear_of(things: Mapping[str, Placed], rig: Rig) -> None:
    """Raise BadOptions for a thing in the rover, or where one of its cameras can come."""
    reach_m = ROVER_M
    mast_m = float(np.hypot(*rig.mast.translation_m[:2])) + abs(rig.mast.axis_offset_m)
    for camera in rig.cameras.values():
        far_m = float(np.linalg.norm(camera.model.C)) if camera.on == "head" else 0.0
        own_m = mast_m + far_m if camera.on == "head" else float(np.hypot(*camera.model.C[:2]))
        reach_m = max(reach_m, own_m + CLEAR_M)
    for key, thing in things.items():
        outline = _hull(footprint_m(thing).astype(np.float32))
        away_m = -float(cv2.pointPolygonTest(outline, (0.0, 0.0), True))
        if away_m < reach_m:
            where = f"({thing.x_m:g}, {thing.y_m:g}) m"
            raise BadOptions(
                f"{key} at {where} comes within {max(away_m, 0.0):.2f} m of the rover's origin, expected "
                f"{reach_m:.2f} m at least: so far the rover and its cameras reach"
            )


def _hull(outline: NDArray[np.float32]) -> Any:
    return cv2.convexHull(outline)


class SceneSettings(DriverOptions):
    """What a scene is made of."""

    seed: Annotated[int, Field(ge=0, le=2**63)] = 1
    """Of everything that is scattered."""
    relief_m: Annotated[float, Field(ge=0.0, le=1.0)] = 0.15
    """How far the ground rises and falls about z = 0, metres; 0 gives flat textured ground."""
    rocks: Annotated[int | tuple[PlacedRock, ...], placed_or("rocks", 500)] = 50
    """How many stones of 0.05-0.6 m lie 1.5-20 m away within 1.5 rad of north; or just these."""
    bricks: Annotated[int | tuple[PlacedBrick, ...], placed_or("bricks", 24)] = 0
    """How many bricks stand ahead, by turns 1.8 m and 6 m away, as far as there is space; or just these."""
    boards: Annotated[tuple[PlacedBoard, ...], placed_or("boards")] = ()
    """Boards that stand there. Where one does, or a brick or rock was placed, no scattered one is."""
    sun_azimuth_rad: Annotated[float, Field(ge=-1e3, le=1e3)] = -1.95
    """Where the sun stands, from north over east."""
    sun_elevation_rad: Annotated[float, Field(ge=0.2, le=1.5)] = 0.70
    """Where the sun stands, above the horizon."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_apart(self.placed)
        return self

    @property
    def placed(self) -> dict[str, Placed]:
        """All that was placed, by where it stands in a configuration."""
        lists: dict[str, Any] = {"rocks": self.rocks, "bricks": self.bricks, "boards": self.boards}
        return {
            f"simulation.scene.{kind}[{k}]": thing
            for kind, things in lists.items()
            if isinstance(things, tuple)
            for k, thing in enumerate(things)
        }
