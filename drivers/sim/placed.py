"""What a configuration puts into the scene: rocks, bricks and boards, checked before anything is built.

Places are in the site frame (x north, y east), which is the rover frame as long as the rover has not moved.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.geometry.rig import Rig
from calib.targets.boards import Charuco, DotBoard
from drivers.errors import BadOptions
from drivers.faults import nearest
from drivers.options import check_bounds, filled

Float64 = NDArray[np.float64]

REACH_M = 28.0
"""How far from the middle of the ground things may be placed, and the rover may stand, along x and y."""

MOST = {"rocks": 500, "bricks": 100, "boards": 24}
BOARD_M = 0.02  # thick
ROVER_M = 0.5  # from its origin nothing is placed nearer than this, or than its cameras reach
CLEAR_M = 0.05  # beyond the cameras' reach
DICTIONARIES = {name: getattr(cv2.aruco, name) for name in dir(cv2.aruco) if name.startswith("DICT_")}


@dataclass(frozen=True)
class PlacedRock:
    """A stone: where, how wide, how it is turned; its shape is of the scene's seed and its place."""

    x_m: float = math.nan
    y_m: float = math.nan
    diameter_m: float = 0.3
    heading_rad: float = 0.0


@dataclass(frozen=True)
class PlacedBrick:
    """A box level on the ground; its length points along the heading."""

    x_m: float = math.nan
    y_m: float = math.nan
    heading_rad: float = 0.0
    length_m: float = 0.39
    width_m: float = 0.19
    height_m: float = 0.19


@dataclass(frozen=True)
class PlacedDots:
    """Round dots in rows and columns, as of a survey's board; the margin is from the outer dots' centres."""

    rows: int = 10
    columns: int = 10
    spacing_m: float = 0.08
    dot_diameter_m: float = 0.04
    margin_m: float = 0.08

    @property
    def board(self) -> DotBoard:
        """What is printed."""
        return DotBoard(self.columns, self.rows, self.spacing_m, self.dot_diameter_m)

    @property
    def paper_m(self) -> float:
        """White paper around the print."""
        return self.margin_m - self.dot_diameter_m / 2


@dataclass(frozen=True)
class PlacedCharuco:
    """A ChArUco board of OpenCV: squares in rows and columns, markers of a dictionary in the white ones."""

    rows: int = 7
    columns: int = 10
    square_m: float = 0.08
    marker_m: float = 0.06
    dictionary: str = "DICT_5X5_100"
    margin_m: float = 0.02

    @property
    def board(self) -> Charuco:
        """What is printed."""
        return Charuco(self.columns, self.rows, self.square_m, self.marker_m, self.dictionary)

    @property
    def paper_m(self) -> float:
        """White paper around the print."""
        return self.margin_m


FACES: Mapping[str, Any] = {"dots": PlacedDots(), "charuco": PlacedCharuco()}


@dataclass(frozen=True)
class PlacedBoard:
    """A board: the middle of its lower edge over (x, y), ``raised_m`` over the ground.

    Its face looks along the heading (by default towards the site's origin), ``lean_rad`` upwards.
    """

    x_m: float = math.nan
    y_m: float = math.nan
    heading_rad: float = math.nan
    lean_rad: float = 0.0
    raised_m: float = 0.0
    face: PlacedDots | PlacedCharuco = PlacedDots()

    @property
    def size_m(self) -> Float64:
        """Width and height with the white paper, (2,)."""
        return np.array(self.face.board.size_m) + 2 * self.face.paper_m


Placed = PlacedRock | PlacedBrick | PlacedBoard

_ANGLE = (-2 * math.pi, 2 * math.pi)
_PLACE = {"x_m": (-REACH_M, REACH_M), "y_m": (-REACH_M, REACH_M), "heading_rad": _ANGLE}
BOUNDS: Mapping[type, Mapping[str, tuple[float, float]]] = {
    PlacedRock: {**_PLACE, "diameter_m": (0.03, 3.0)},
    PlacedBrick: {**_PLACE, "length_m": (0.02, 3.0), "width_m": (0.02, 3.0), "height_m": (0.02, 3.0)},
    PlacedBoard: {**_PLACE, "lean_rad": (-1.0, 1.0), "raised_m": (0.0, 3.0)},
    PlacedDots: {
        "rows": (2, 50), "columns": (2, 50), "spacing_m": (0.005, 1.0), "dot_diameter_m": (0.002, 1.0),
        "margin_m": (0.0, 1.0),
    },
    PlacedCharuco: {
        "rows": (2, 50), "columns": (2, 50), "square_m": (0.005, 1.0), "marker_m": (0.002, 1.0),
        "margin_m": (0.0, 1.0),
    },
}  # fmt: skip


def read_list(kind: str, values: Sequence[Any]) -> tuple[Any, ...]:
    """Return the placed rocks, bricks or boards of ``simulation.scene``.

    Raises BadOptions with the place in the configuration, the value, and what would be right.
    """
    key = f"simulation.scene.{kind}"
    if len(values) > MOST[kind]:
        raise BadOptions(f"{key} are {len(values)}, expected {MOST[kind]} at most")
    return tuple(_one(kind, value, f"{key}[{k}]") for k, value in enumerate(values))


def _one(kind: str, value: Any, key: str) -> Placed:
    if not isinstance(value, Mapping):
        raise BadOptions(f"{key} is {value!r}, expected keys and values, as {{x_m: 5, y_m: 0}}")
    for needed in ("x_m", "y_m"):
        if needed not in value:
            raise BadOptions(f"{key} has no {needed}; metres in the site frame are expected")
    if kind == "boards":
        return _board(dict(value), key)
    thing: Placed = filled(PlacedRock() if kind == "rocks" else PlacedBrick(), value, key)
    check_bounds(thing, BOUNDS[type(thing)], key)
    return thing


def _board(value: dict[str, Any], key: str) -> PlacedBoard:
    """A board's place, and its face by the kind."""
    kind = value.pop("kind", "dots")
    if kind not in FACES:
        raise BadOptions(f"{key}.kind is {kind!r}{nearest(str(kind), FACES)}")
    own = {f.name for f in fields(PlacedBoard)} - {"face"}
    known = {f.name for f in fields(FACES[kind])}
    for name in value:
        if name not in own | known:
            raise BadOptions(f"{key} has no key {name!r} for kind {kind!r}{nearest(str(name), own | known)}")
    face = filled(FACES[kind], {k: v for k, v in value.items() if k in known}, key)
    check_bounds(face, BOUNDS[type(face)], key)
    _check_face(face, key)
    plain: PlacedBoard = filled(PlacedBoard(), {k: v for k, v in value.items() if k in own}, key)
    board = replace(plain, face=face)
    if math.isnan(board.heading_rad) and "heading_rad" not in value:
        board = replace(board, heading_rad=math.atan2(-board.y_m, -board.x_m))
    check_bounds(board, BOUNDS[PlacedBoard], key)
    if not 0.05 <= board.size_m.max() <= 4.0:
        raise BadOptions(f"{key} is {board.size_m[0]:g} x {board.size_m[1]:g} m, expected 0.05 to 4 m")
    return board


def _check_face(face: PlacedDots | PlacedCharuco, key: str) -> None:
    """What two values of a face must be to each other."""
    if isinstance(face, PlacedDots) and not face.dot_diameter_m < face.spacing_m:
        raise BadOptions(
            f"{key}.dot_diameter_m is {face.dot_diameter_m!r}, expected less than spacing_m, "
            f"{face.spacing_m!r}"
        )
    if isinstance(face, PlacedDots) and not face.margin_m >= face.dot_diameter_m / 2:
        raise BadOptions(
            f"{key}.margin_m is {face.margin_m!r}, expected half a dot at least, {face.dot_diameter_m / 2:g}"
        )
    if isinstance(face, PlacedCharuco):
        if not face.marker_m < face.square_m:
            raise BadOptions(
                f"{key}.marker_m is {face.marker_m!r}, expected less than square_m, {face.square_m!r}"
            )
        if face.dictionary not in DICTIONARIES:
            raise BadOptions(
                f"{key}.dictionary is {face.dictionary!r}{nearest(face.dictionary, DICTIONARIES)}"
            )
        holds = len(cv2.aruco.getPredefinedDictionary(DICTIONARIES[face.dictionary]).bytesList)
        if face.rows * face.columns // 2 > holds:
            raise BadOptions(
                f"{key}: {face.rows} x {face.columns} squares need {face.rows * face.columns // 2} markers, "
                f"{face.dictionary} has {holds}"
            )


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


def heights_m(thing: Placed) -> tuple[float, float]:
    """Return from where to where a thing reaches over the ground."""
    if isinstance(thing, PlacedRock):
        return 0.0, 0.8 * thing.diameter_m
    if isinstance(thing, PlacedBrick):
        return 0.0, thing.height_m
    return thing.raised_m, thing.raised_m + thing.size_m[1] * math.cos(thing.lean_rad)


def named(rocks: Any, bricks: Any, boards: Any) -> dict[str, Placed]:
    """Return all placed things by where they stand in the configuration."""
    lists = {"rocks": rocks, "bricks": bricks, "boards": boards}
    return {
        f"simulation.scene.{kind}[{k}]": thing
        for kind, things in lists.items()
        if isinstance(things, tuple)
        for k, thing in enumerate(things)
    }


def check_apart(things: Mapping[str, Placed]) -> None:
    """Pass things of which none stands in another. Raises BadOptions with the first pair."""
    outlines = {key: footprint_m(thing).astype(np.float32) for key, thing in things.items()}
    keys = list(things)
    for k, key in enumerate(keys):
        low, high = heights_m(things[key])
        for other in keys[:k]:
            other_low, other_high = heights_m(things[other])
            if min(high, other_high) <= max(low, other_low):
                continue
            area_m2, _ = cv2.intersectConvexConvex(_hull(outlines[key]), _hull(outlines[other]))
            if area_m2 > 1e-6:
                raise BadOptions(
                    f"{key} at ({things[key].x_m:g}, {things[key].y_m:g}) m stands in {other} at "
                    f"({things[other].x_m:g}, {things[other].y_m:g}) m, expected things apart from each other"
                )


def check_clear_of(things: Mapping[str, Placed], rig: Rig) -> None:
    """Pass things that stand outside the rover, and where no camera can come. Raises BadOptions."""
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
