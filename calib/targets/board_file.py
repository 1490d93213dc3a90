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

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from calib.errors import BadFile
from calib.files import read_bytes
from calib.files.atomic import save_bytes
from calib.files.yaml_text import MAX_BYTES, Section, dump_mapping, kind_of, parse_mapping
from calib.targets.boards import AnyBoard, AprilGrid, Charuco, Checkerboard, DotBoard

SCHEMA = "mastctl/board/1"

KINDS = ("charuco", "aprilgrid", "dots", "checkerboard")

LARGEST_M, MOST_CELLS = 10.0, 100

WORST_SCALE, WORST_ASPECT = 0.3, 0.03
"""A bar that differs more than this from the drawn one is another bar, or has other units."""

KEYS: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "charuco": (("square_m", "marker_m", "dictionary"), ("first_id", "legacy")),
    "aprilgrid": (("tag_m", "gap_m"), ("family", "first_id", "border")),
    "dots": (("spacing_m", "dot_diameter_m"), ()),
    "checkerboard": (("square_m",), ()),
}
_GRID_KEYS = ("kind", "columns", "rows")
_PRINT_KEYS = ("bar_m", "measured", "aspect")

FAMILIES = {
    "tag36h11": "DICT_APRILTAG_36h11",
    "tag25h9": "DICT_APRILTAG_25h9",
    "tag16h5": "DICT_APRILTAG_16h5",
}
"""AprilTag's families to OpenCV's dictionaries of them."""


def load_board(path: str | Path) -> AnyBoard:
    """Read a BOARD.yaml; the board has the sizes of the print.

    Raises
    ------
    BadFile
        If it cannot be read or is no board: which key, what it holds, what is expected.
    """
    return parse_board(read_bytes(path, MAX_BYTES), path)


def parse_board(data: bytes, path: str | Path) -> AnyBoard:
    """Return the board that a BOARD.yaml's bytes hold; ``path`` is for messages. Raises BadFile."""
    document = parse_mapping(data, path)
    schema = document.pop("schema", None)
    if schema != SCHEMA:
        raise BadFile(path, "schema", f"{kind_of(schema)} where '{SCHEMA}' is expected")
    return board_of(path, "", document)


def save_board(
    path: str | Path,
    board: AnyBoard,
    bar_m: tuple[float, float] | None = None,
    name: str = "",
    measured_m: tuple[float, float | None] | None = None,
) -> None:
    """Write a BOARD.yaml atomically, after it was read as it will be.

    Parameters
    ----------
    board
        As drawn.
    bar_m, measured_m
        The bars' lengths as drawn, and as measured on the print, across and down.

    Raises
    ------
    BadFile
        If a bar cannot have been measured so, or the file system refuses.
    """
    document: dict[str, Any] = {"schema": SCHEMA}
    if name:
        document["name"] = name
    document |= document_of(board)
    if bar_m is not None:
        document["bar_m"] = {"across": bar_m[0], "down": bar_m[1]}
    if measured_m is not None:
        document["measured"] = _measured(*measured_m)
    _save(path, document)


def measure(path: str | Path, across_m: float, down_m: float | None = None) -> tuple[float, float]:
    """Write the measured lengths of a print's bars into its BOARD.yaml, and return the drawn ones.

    The version before stays beside it. Raises BadFile: it is no board, has no bar, or none so long.
    """
    document = parse_mapping(read_bytes(path, MAX_BYTES), path)
    load_board(path)
    document["measured"] = _measured(across_m, down_m)
    _save(path, document)
    return document["bar_m"]["across"], document["bar_m"]["down"]


def bars_of(path: str | Path) -> tuple[float, float] | None:
    """Return the lengths of a BOARD.yaml's bars as drawn, across and down, metres; None if it has none."""
    load_board(path)
    bars = parse_mapping(read_bytes(path, MAX_BYTES), path).get("bar_m")
    return None if bars is None else (bars["across"], bars["down"])


def _measured(across_m: float, down_m: float | None) -> dict[str, float]:
    return {"across_m": across_m} | ({} if down_m is None else {"down_m": down_m})


def _save(path: str | Path, document: dict[str, Any]) -> None:
    board_of(path, "", {key: value for key, value in document.items() if key != "schema"})
    save_bytes(path, dump_mapping(document))


def document_of(board: AnyBoard) -> dict[str, Any]:
    """Return what a file holds of a board, as plain data."""
    required, optional = KEYS[board.kind]
    document: dict[str, Any] = {"kind": board.kind, "columns": board.columns, "rows": board.rows}
    document |= {key: getattr(board, key) for key in (*required, *optional)}
    if board.aspect != 1.0:
        document["aspect"] = board.aspect
    return document


def board_of(path: str | Path, place: str, value: Any) -> AnyBoard:
    """Return the board that a mapping of a file holds.

    Raises
    ------
    BadFile
        With the file, the key, what it holds, and what is expected.
    """
    if not isinstance(value, dict):
        raise BadFile(path, place, f"{kind_of(value)} where a board with its kind is expected")
    if "kind" not in value:
        raise BadFile(
            path, f"{place}.kind" if place else "kind", f"the key is missing; {', '.join(KINDS)} are kinds"
        )
    # the kind first: it says which other keys there may be
    kind = Section(path, place, {"kind": value["kind"]}, ("kind",)).choice("kind", KINDS)
    required, optional = KEYS[kind]
    section = Section(path, place, value, (*_GRID_KEYS, *required), (*optional, *_PRINT_KEYS, "name"))
    if "name" in section:
        section.text("name")
    board = _drawn(kind, section)
    if "aspect" in section:
        board = replace(board, aspect=_near(section, "aspect", section.number("aspect"), 1.0, WORST_ASPECT))
    return _as_printed(board, section)


def _drawn(kind: str, section: Section) -> AnyBoard:
    columns, rows = section.integer("columns", 2, MOST_CELLS), section.integer("rows", 2, MOST_CELLS)
    if kind in ("charuco", "checkerboard") and min(columns, rows) < 3:
        raise section.bad("columns", f"{columns} x {rows} squares where 3 x 3 at least are expected")
    if kind == "charuco":
        return _charuco(section, columns, rows)
    if kind == "aprilgrid":
        return _aprilgrid(section, columns, rows)
    if kind == "checkerboard":
        return Checkerboard(columns, rows, section.positive("square_m", LARGEST_M))
    spacing_m, dot_m = section.positive("spacing_m", LARGEST_M), section.positive("dot_diameter_m", LARGEST_M)
    if dot_m >= spacing_m:
        raise section.bad("dot_diameter_m", f"{dot_m:g} where less than spacing_m {spacing_m:g} is expected")
    return DotBoard(columns, rows, spacing_m, dot_m)


def _charuco(section: Section, columns: int, rows: int) -> Charuco:
    square_m, marker_m = section.positive("square_m", LARGEST_M), section.positive("marker_m", LARGEST_M)
    if marker_m >= square_m:
        raise section.bad("marker_m", f"{marker_m:g} where less than square_m {square_m:g} is expected")
    dictionary = section.choice("dictionary", dictionaries())
    first_id = _first_id(section, dictionary, columns * rows // 2, "markers")
    legacy = False
    if "legacy" in section:
        legacy = section.values["legacy"]
        if not isinstance(legacy, bool):
            raise section.bad("legacy", f"{kind_of(legacy)} where true or false is expected")
    return Charuco(columns, rows, square_m, marker_m, dictionary, first_id, legacy)


def _aprilgrid(section: Section, columns: int, rows: int) -> AprilGrid:
    tag_m, gap_m = section.positive("tag_m", LARGEST_M), section.positive("gap_m", LARGEST_M)
    if gap_m > tag_m:
        raise section.bad("gap_m", f"{gap_m:g} where at most tag_m {tag_m:g} is expected")
    family = section.choice("family", tuple(FAMILIES)) if "family" in section else "tag36h11"
    first_id = _first_id(section, FAMILIES[family], columns * rows, "tags")
    border = section.integer("border", 1, 4) if "border" in section else 2
    return AprilGrid(columns, rows, tag_m, gap_m, family, first_id, border)


def _first_id(section: Section, dictionary: str, needed: int, what: str) -> int:
    """The first marker's number, all markers being in the dictionary."""
    holds = dictionary_size(dictionary)
    if needed > holds:
        raise section.bad(
            "columns", f"the board needs {needed} {what}, and {dictionary} has {holds}; fewer are expected"
        )
    return section.integer("first_id", 0, holds - needed) if "first_id" in section else 0


def _as_printed(board: AnyBoard, section: Section) -> AnyBoard:
    """The board with the sizes that the measured bars give it."""
    if "measured" not in section:
        if "bar_m" in section:
            _bars(section)
        return board
    if "bar_m" not in section:
        raise section.bad(
            "measured", "there is no bar_m; a measured length says nothing without the one drawn"
        )
    drawn_across_m, drawn_down_m = _bars(section)
    measured = section.section("measured", ("across_m",), ("down_m",))
    across = _near(measured, "across_m", measured.number("across_m"), drawn_across_m, WORST_SCALE)
    scale = across / drawn_across_m
    aspect = board.aspect
    if "down_m" in measured:
        down = measured.number("down_m")
        aspect *= _near(measured, "down_m", down, drawn_down_m * scale, WORST_ASPECT) / (drawn_down_m * scale)
    return scaled(board, scale, aspect)


def scaled(board: AnyBoard, scale: float, aspect: float) -> AnyBoard:
    """Return the board with every length times ``scale``, and another aspect."""
    lengths = [key for key in (*KEYS[board.kind][0],) if key.endswith("_m")]
    return replace(board, **{key: scale * getattr(board, key) for key in lengths}, aspect=aspect)


def _bars(section: Section) -> tuple[float, float]:
    bars = section.section("bar_m", ("across", "down"))
    return bars.positive("across", LARGEST_M), bars.positive("down", LARGEST_M)


def _near(section: Section, key: str, value: float, wanted: float, part: float) -> float:
    """A number that is within a part of the one expected."""
    low, high = wanted * (1 - part), wanted * (1 + part)
    if not low <= value <= high:
        raise section.bad(key, f"{value:g} where {low:.4g} to {high:.4g} is expected, {wanted:.4g} as drawn")
    return value


def dictionary_size(name: str) -> int:
    """Return how many markers a dictionary has, by OpenCV's name."""
    import cv2  # a survey with a station is read without it

    return len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)).bytesList)


def dictionaries() -> tuple[str, ...]:
    """Return OpenCV's names of marker dictionaries."""
    import cv2

    return tuple(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
