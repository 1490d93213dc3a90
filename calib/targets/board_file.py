"""BOARD.yaml: a board as it was drawn, and what a ruler says about the print.

    schema: mastctl/board/1
    kind: charuco
    columns: 9
    rows: 12
    square_m: 0.02
    marker_m: 0.015
    dictionary: DICT_5X5_100
    bar_m: {across: 0.15, down: 0.15}         # as drawn
    measured: {across_m: 0.1497}              # as printed; down_m too where it differs

The board that is read has the sizes of the print: each times measured over drawn.
"""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, ConfigDict, Field, RootModel, model_validator

from calib.files import read_bytes, save_bytes
from calib.files.records import ABSENT, Record, Text, parse_record, problem, read_record
from calib.files.yaml_text import MAX_BYTES, dump_mapping, kind_of, parse_mapping
from calib.targets.boards import AnyBoard, AprilGrid, Charuco, Checkerboard, DotBoard

SCHEMA = "mastctl/board/1"

WORST_SCALE, WORST_ASPECT = 0.3, 0.03
"""A bar that differs more than this from the drawn one is another bar, or has other units."""

_Cells = Annotated[int, Field(ge=2, le=100)]
_Metres = Annotated[float, Field(gt=0.0, le=10.0)]

FAMILIES = {
    "tag36h11": "DICT_APRILTAG_36h11",
    "tag25h9": "DICT_APRILTAG_25h9",
    "tag16h5": "DICT_APRILTAG_16h5",
}
"""AprilTag's families to OpenCV's dictionaries of them."""


def dictionary_size(name: str) -> int:
    """Return how many markers a dictionary has, by OpenCV's name."""
    import cv2  # a survey with a station is read without it

    return len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)).bytesList)


def dictionaries() -> tuple[str, ...]:
    """Return OpenCV's names of marker dictionaries."""
    import cv2

    return tuple(name for name in dir(cv2.aruco) if name.startswith("DICT_"))


def _dictionary(name: str) -> str:
    if name not in dictionaries():
        raise problem("", f"{kind_of(name)} where one of {', '.join(dictionaries())} is expected")
    return name


class _DictionaryNames:
    """Names them in a JSON Schema, for which alone OpenCV is loaded."""

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: Any, handler: Any) -> dict[str, Any]:
        return {"enum": list(dictionaries())}


class BarsRecord(Record):
    """Lengths of the bars as drawn."""

    across: _Metres
    down: _Metres


class MeasuredRecord(Record):
    """Lengths of the bars as a ruler finds them on the print."""

    across_m: _Metres
    down_m: _Metres = Field(default=ABSENT)


class _BoardRecord(Record, json_schema_extra={"dependentRequired": {"measured": ["bar_m"]}}):
    """The keys that every kind of board has."""

    schema_: Literal["mastctl/board/1"] = Field(default=ABSENT, alias="schema")
    name: Text = Field(default=ABSENT)
    columns: _Cells
    rows: _Cells
    aspect: Annotated[float, Field(ge=1.0 - WORST_ASPECT, le=1.0 + WORST_ASPECT)] = 1.0
    bar_m: BarsRecord = Field(default=ABSENT)
    measured: MeasuredRecord = Field(default=ABSENT)

    drawn: ClassVar[type[AnyBoard]]
    """The board that the keys are of."""

    @property
    def board(self) -> AnyBoard:
        """The board with the sizes that the measured bars give it."""
        board = self.drawn(**{key.name: getattr(self, key.name) for key in fields(self.drawn)})
        if self.measured is None:
            return board
        if self.bar_m is None:
            reason = "there is no bar_m; a measured length says nothing without the one drawn"
            raise problem("measured", reason)
        aspect = board.aspect
        scale = _scale("across_m", self.measured.across_m, self.bar_m.across, WORST_SCALE)
        if self.measured.down_m is not None:
            aspect *= _scale("down_m", self.measured.down_m, self.bar_m.down * scale, WORST_ASPECT)
        lengths = {key: scale * getattr(board, key) for key in vars(board) if key.endswith("_m")}
        return replace(board, **lengths, aspect=aspect)

    @model_validator(mode="after")
    def _can_be_drawn(self) -> _BoardRecord:
        cells = self.columns * self.rows
        match self:
            case CharucoRecord() | CheckerboardRecord() if min(self.columns, self.rows) < 3:
                size = f"{self.columns} x {self.rows}"
                raise problem("columns", f"{size} squares where 3 x 3 at least are expected")
            case CharucoRecord():
                refuse_larger(self, "marker_m", "square_m")
                _refuse_markers(self.first_id, cells // 2, "markers", self.dictionary)
            case AprilGridRecord():
                if self.gap_m > self.tag_m:
                    raise problem("gap_m", f"{self.gap_m:g} where at most tag_m {self.tag_m:g} is expected")
                _refuse_markers(self.first_id, cells, "tags", FAMILIES[self.family])
            case DotBoardRecord():
                refuse_larger(self, "dot_diameter_m", "spacing_m")
        _ = self.board
        return self


def refuse_larger(record: Record, key: str, other: str) -> None:
    """Refuse a length of a record that is not less than another. Raises `problem`."""
    length, limit = getattr(record, key), getattr(record, other)
    if length >= limit:
        raise problem(key, f"{length:g} where less than {other} {limit:g} is expected")


def _refuse_markers(first_id: int, needed: int, what: str, dictionary: str) -> None:
    """Refuse markers that are not in the dictionary."""
    size = dictionary_size(dictionary)
    if needed > size:
        reason = f"the board needs {needed} {what}, and {dictionary} has {size}; fewer are expected"
        raise problem("columns", reason)
    if first_id > size - needed:
        raise problem("first_id", f"{first_id} where an integer from 0 to {size - needed} is expected")


class CharucoRecord(_BoardRecord):
    """A ChArUco board."""

    kind: Literal["charuco"]
    square_m: _Metres
    marker_m: _Metres
    dictionary: Annotated[str, AfterValidator(_dictionary), _DictionaryNames]
    first_id: Annotated[int, Field(ge=0, le=1023)] = 0
    legacy: bool = False

    drawn = Charuco


class AprilGridRecord(_BoardRecord):
    """Kalibr's AprilGrid."""

    kind: Literal["aprilgrid"]
    tag_m: _Metres
    gap_m: _Metres
    family: Literal["tag36h11", "tag25h9", "tag16h5"] = "tag36h11"
    first_id: Annotated[int, Field(ge=0, le=1023)] = 0
    border: Annotated[int, Field(ge=1, le=4)] = 2

    drawn = AprilGrid


class DotBoardRecord(_BoardRecord):
    """Dots in rows and columns."""

    kind: Literal["dots"]
    spacing_m: _Metres
    dot_diameter_m: _Metres

    drawn = DotBoard


class CheckerboardRecord(_BoardRecord):
    """A plain chessboard."""

    kind: Literal["checkerboard"]
    square_m: _Metres

    drawn = Checkerboard


_AnyRecord = Annotated[
    CharucoRecord | AprilGridRecord | DotBoardRecord | CheckerboardRecord, Field(discriminator="kind")
]


class BoardRecord(RootModel[_AnyRecord]):
    """A board inside a file: `kind` names its other keys."""


class BoardFileRecord(BoardRecord):
    """A BOARD.yaml."""

    model_config = ConfigDict(json_schema_extra={"required": ["schema", "kind"]})


def _scale(key: str, value: float, wanted: float, part: float) -> float:
    """A measured length over the one expected, if it is within a part of that."""
    low, high = wanted * (1 - part), wanted * (1 + part)
    if not low <= value <= high:
        reason = f"{value:g} where {low:.4g} to {high:.4g} is expected, {wanted:.4g} as drawn"
        raise problem(f"measured.{key}", reason)
    return value / wanted


def load_board(path: str | Path) -> AnyBoard:
    """Read a BOARD.yaml; the board has the sizes of the print.

    Raises BadFile if it cannot be read or is no board: which key, what it holds, what is expected.
    """
    return parse_board(read_bytes(path, MAX_BYTES), path)


def parse_board(data: bytes, path: str | Path) -> AnyBoard:
    """Return the board that a BOARD.yaml's bytes hold; ``path`` is for messages. Raises BadFile."""
    return parse_record(BoardFileRecord, data, path, SCHEMA).root.board


def save_board(
    path: str | Path,
    board: AnyBoard,
    bar_m: tuple[float, float] | None = None,
    name: str = "",
) -> None:
    """Write a BOARD.yaml atomically, after it was read as it will be.

    ``board`` is as drawn, ``bar_m`` are the bars' lengths, across and down. Raises BadFile if the file system
    refuses.
    """
    document: dict[str, Any] = {"schema": SCHEMA}
    if name:
        document["name"] = name
    document |= document_of(board)
    if bar_m is not None:
        document["bar_m"] = {"across": bar_m[0], "down": bar_m[1]}
    _save(path, document)


def measure(path: str | Path, across_m: float, down_m: float | None = None) -> tuple[float, float]:
    """Write the measured lengths of a print's bars into its BOARD.yaml, and return the drawn ones.

    The version before stays beside it. Raises BadFile: it is no board, has no bar, or none so long.
    """
    data = read_bytes(path, MAX_BYTES)
    parse_board(data, path)
    measured = {"across_m": across_m} | ({} if down_m is None else {"down_m": down_m})
    document = parse_mapping(data, path) | {"measured": measured}
    _save(path, document)
    return document["bar_m"]["across"], document["bar_m"]["down"]


def _save(path: str | Path, document: dict[str, Any]) -> None:
    read_record(BoardFileRecord, document, path)
    save_bytes(path, dump_mapping(document))


def document_of(board: AnyBoard) -> dict[str, Any]:
    """Return what a file holds of a board, as plain data."""
    keys = [key.name for key in fields(board) if key.name != "aspect" or board.aspect != 1.0]
    return {"kind": board.kind, **{key: getattr(board, key) for key in keys}}


def board_of(path: str | Path, place: str, value: Any) -> AnyBoard:
    """Return the board that a mapping of a file holds. Raises BadFile as `load_board`."""
    return read_record(BoardRecord, value, path, place).root.board
