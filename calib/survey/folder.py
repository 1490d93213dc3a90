"""Reads the parts of every survey folder: its files, images' sizes, rows of its tables, and survey.yaml.

Each value is refused with its file and line, or its key.
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from calib.errors import BadFile
from calib.files import LARGEST_IMAGE_PX, digest_of, read_bytes
from calib.files.mast_file import CAMERA_NAME, CAMERA_NAME_WORDS, read_sensor_mode
from calib.files.tables import NUMBER, check_header
from calib.files.yaml_text import MAX_BYTES, Section, nearest, parse_mapping
from calib.geometry.cahvor import FITTED, Kind
from calib.geometry.rigid import FloatArray
from calib.survey.records import Sigma, SurveyCamera, SurveyImage
from calib.targets.boards import Board

_PNG = b"\x89PNG\r\n\x1a\n"
_NO_FRAME = {0xC4, 0xC8, 0xCC}


def picture_size_px(path: Path) -> tuple[int, int] | None:
    """Return (width, height) in pixels; None where the file is neither PNG nor JPEG, or is cut short.

    Raises
    ------
    OSError
        If the file cannot be read.
    """
    with path.open("rb") as file:
        head = file.read(1 << 18)
    if head.startswith(_PNG) and head[12:16] == b"IHDR" and len(head) >= 24:
        return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
    return _jpeg_size_px(head) if head.startswith(b"\xff\xd8") else None


def spoiled_png(data: bytes) -> str | None:
    """Return why a PNG file cannot be decoded, None if each of its chunks is whole (or it is no PNG).

    libpng writes about such files to stderr past every Python handler; so it does not get them.
    """
    if not data.startswith(_PNG):
        return None
    at = len(_PNG)
    while at + 12 <= len(data):
        end = at + 8 + int.from_bytes(data[at : at + 4], "big")
        if end + 4 > len(data):
            break
        if zlib.crc32(data[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            return "a part of it is damaged"
        if data[at + 4 : at + 8] == b"IEND":
            return None
        at = end + 4
    return "it is cut short"


def _jpeg_size_px(head: bytes) -> tuple[int, int] | None:
    """Walk the segments to the frame header (ISO 10918-1, B.2.2: SOF, length, precision, height, width)."""
    at = 2
    while at + 9 <= len(head) and head[at] == 0xFF:
        marker = head[at + 1]
        if marker == 0xFF:
            at += 1
        elif 0xC0 <= marker <= 0xCF and marker not in _NO_FRAME:
            height, width = (int.from_bytes(head[i : i + 2], "big") for i in (at + 5, at + 7))
            return width, height
        else:
            at += 2 + int.from_bytes(head[at + 2 : at + 4], "big")
    return None


MAX_ROWS = 2_000_000


class Row:
    """One row; ``line`` counts from 1, the header's line."""

    def __init__(self, path: Path, line: int, cells: Mapping[str, str]) -> None:
        self.path, self.line, self.cells = path, line, cells

    def bad(self, column: str, reason: str) -> BadFile:
        """Return the refusal of a cell, or of the whole row for the column ''."""
        return BadFile(self.path, f"line {self.line}, {column}" if column else f"line {self.line}", reason)

    def text(self, column: str) -> str:
        """Return a cell that must not be empty."""
        word = self.cells[column]
        if not word:
            raise self.bad(column, "is empty; a name is expected")
        if not word.isprintable():
            raise self.bad(column, f"{word[:40]!r} where printable text is expected")
        return word

    def choice(self, column: str, choices: Sequence[str], what: str) -> str:
        """Return a cell that must be one of the given words; ``what`` says what they are."""
        word = self.text(column)
        if word not in choices:
            raise self.bad(column, f"'{word[:40]}' is no {what}; {nearest(word, list(choices))}")
        return word

    def number(self, column: str, limit: float) -> float:
        """Return a cell that must be a finite number of at most ``limit`` in size."""
        word = self.cells[column]
        if not NUMBER.fullmatch(word):
            raise self.bad(column, f"'{word[:40]}' where a number is expected")
        value = float(word)
        if not math.isfinite(value) or abs(value) > limit:
            raise self.bad(column, f"{word[:40]} where a finite number up to {limit:g} is expected")
        return value

    def index(self, column: str, count: int) -> int:
        """Return a cell that must be an integer from 0 to count - 1."""
        value = self.number(column, 1e9)
        if value != int(value) or not 0 <= value < count:
            raise self.bad(
                column, f"{self.cells[column][:40]} where an integer from 0 to {count - 1} is expected"
            )
        return int(value)

    def numbers(self, columns: Sequence[str], limit: float) -> list[float]:
        """Return several cells as ``number`` does."""
        return [self.number(column, limit) for column in columns]


def rows_of(
    data: bytes, path: Path, columns: Sequence[str], may_be_there: Sequence[str] | None = None
) -> Iterator[Row]:
    """Yield the rows of a CSV file's bytes; blanks around a cell do not count.

    Parameters
    ----------
    columns
        Exactly these in this order; or, with ``may_be_there``, these and any of those, in any order.

    Raises
    ------
    BadFile
        For what is no UTF-8 CSV with such columns, and for a row of another length.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise BadFile(path, f"line {line}", f"byte 0x{data[error.start]:02x} is not UTF-8 text") from None
    lines = csv.reader(io.StringIO(text, newline=""), strict=True)
    blank_line = 0
    count = 0
    try:
        header = next(lines, [])
        if may_be_there is not None:
            columns = _header(header, path, columns, may_be_there)
        else:
            check_header(header, path, columns)
        for cells in lines:
            line = lines.line_num
            if not cells:
                blank_line = blank_line or line
                continue
            if blank_line:
                raise BadFile(path, f"line {blank_line}", "is blank; a row is expected on every line")
            if len(cells) != len(columns):
                raise BadFile(path, f"line {line}", f"{len(cells)} cells where {len(columns)} are expected")
            count += 1
            if count > MAX_ROWS:
                raise BadFile(path, "", f"has more than {MAX_ROWS} rows, the most that is read")
            yield Row(path, line, dict(zip(columns, map(str.strip, cells), strict=True)))
    except csv.Error as error:
        raise BadFile(path, f"line {lines.line_num}", f"is not CSV: {error}") from None


def _header(
    cells: Sequence[str], path: Path, columns: Sequence[str], may_be_there: Sequence[str]
) -> Sequence[str]:
    """The columns that a header names, all known, each once, none missing that must be there."""
    found = [cell.strip() for cell in cells]
    if not set(found) & set(columns):  # separated by something else, or no header
        check_header(found, path, columns)
    known = [*columns, *may_be_there]
    for name in found:
        if name not in known:
            raise BadFile(path, "line 1", f"'{name[:40]}' is no column; {nearest(name, known)}")
        if found.count(name) > 1:
            raise BadFile(path, "line 1", f"column {name} is there twice")
    for name in columns:
        if name not in found:
            raise BadFile(path, "line 1", f"there is no column {name}; expected '{','.join(columns)}'")
    return found


SCHEMA = "mastctl/survey/1"

CSV_MAX_BYTES = 200_000_000

LARGEST_ANGLE_RAD = 1e4
"""Beyond these a number is not a measurement; the check of the survey judges unlikely ones."""

EDGE_PX = 1.0
"""How far outside its image a dot or corner may have been found: noise at the border."""


class SurveyFolder:
    """One reading of a folder; remembers what it read for the digest.

    Parameters
    ----------
    path
        The folder.
    files
        Names of the files that must be there, for the refusal.
    """

    def __init__(self, path: Path, files: str = "survey.yaml, station.csv and images.csv") -> None:
        self.path, self.files = path, files
        self.digests: dict[str, str] = {}

    def document(self) -> dict[str, object]:
        """Return what survey.yaml holds."""
        if not self.path.is_dir():
            raise BadFile(self.path, "", "is no folder; a survey is a folder with survey.yaml in it")
        return parse_mapping(self.bytes_of("survey.yaml", MAX_BYTES), self.path / "survey.yaml")

    def bytes_of(self, name: str, limit_bytes: int) -> bytes:
        """Return a file's bytes. Raises BadFile."""
        path = self.path / name
        if not path.exists():
            raise BadFile(path, "", f"is missing; a survey has {self.files}")
        data = read_bytes(path, limit_bytes)
        self.digests[name] = digest_of(data)
        return data

    def rows(
        self,
        name: str,
        columns: Sequence[str],
        may_be_there: Sequence[str] | None = None,
        optional: bool = False,
    ) -> Iterator[Row]:
        """Yield a table's rows, as `rows_of` does; none of an optional file that is not there."""
        path = self.path / name
        if optional and not path.exists():
            return iter(())
        return rows_of(self.bytes_of(name, CSV_MAX_BYTES), path, columns, may_be_there)

    def some(self, rows: Sequence[object], name: str, what: str) -> None:
        """Refuse a table without rows."""
        if not rows:
            raise BadFile(
                self.path / name, "", f"has a header and no rows; one for each of {what} is expected"
            )

    def check_picture(self, row: Row, file: str, camera: SurveyCamera) -> None:
        """Refuse a picture of another size, and note its content; one that is missing is for the check."""
        path = self.path / file
        try:
            if not path.is_file():
                return
            size_px = picture_size_px(path)
            with path.open("rb") as stream:
                self.digests[file] = hashlib.file_digest(stream, "sha256").hexdigest()
        except (OSError, ValueError) as error:
            raise row.bad("file", f"'{file[:60]}' cannot be read: {error}") from None
        if size_px is not None and size_px != camera.size_px:
            found, wanted = ("x".join(map(str, size)) for size in (size_px, camera.size_px))
            raise row.bad("file", f"{file} is {found} pixels where {camera.name} of survey.yaml has {wanted}")

    def digest(self) -> str:
        """Return the SHA-256 over names and contents of all that was read."""
        listing = "".join(f"{digest}  {name}\n" for name, digest in sorted(self.digests.items()))
        return digest_of(listing.encode("utf-8", "surrogatepass"))


def joints_of(row: Row, camera: SurveyCamera) -> tuple[float | None, float | None]:
    """Read pan and tilt: both for a head camera, neither for one on the body."""
    for column in ("pan_rad", "tilt_rad"):
        word = row.cells[column]
        if camera.on == "rover" and word:
            raise row.bad(column, f"'{word[:40]}' where nothing is expected: {camera.name} is on the body")
        if camera.on == "head" and not word:
            raise row.bad(column, f"is empty; {camera.name} is on the head and needs the measured angle")
    if camera.on == "rover":
        return None, None
    return row.number("pan_rad", LARGEST_ANGLE_RAD), row.number("tilt_rad", LARGEST_ANGLE_RAD)


def image_of(row: Row, images: Mapping[str, SurveyImage]) -> str:
    name = row.cells["image"]
    return name if name in images else row.choice("image", tuple(images), "image of images.csv")


def pixel_of(row: Row, camera: SurveyCamera) -> tuple[float, float]:
    """Read a pixel that must be inside the image."""
    pixel = row.number("x_px", 1e9), row.number("y_px", 1e9)
    for column, value, size in zip(("x_px", "y_px"), pixel, camera.size_px, strict=True):
        if not -0.5 - EDGE_PX <= value <= size - 0.5 + EDGE_PX:
            shape = "x".join(map(str, camera.size_px))
            raise row.bad(column, f"{value:g} is outside the image of {camera.name}, {shape} pixels")
    return pixel


def once(seen: dict[tuple[str, ...], int], key: tuple[str, ...], row: Row, what: str) -> None:
    """Refuse what is there a second time."""
    if key in seen:
        raise row.bad("", f"{what} is there twice, first on line {seen[key]}")
    seen[key] = row.line


def array_of(values: list[float] | tuple[float, float]) -> FloatArray:
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


FURTHEST_M = 1e5

BOARD_KEYS = ("rows", "columns", "spacing_m", "dot_diameter_m", "tapes_in_board_m")


def dot_board_of(section: Section) -> Board:
    spacing_m, dot_m = (
        section.positive("spacing_m", FURTHEST_M),
        section.positive("dot_diameter_m", FURTHEST_M),
    )
    if dot_m >= spacing_m:
        raise section.bad("dot_diameter_m", f"{dot_m:g} where less than spacing_m {spacing_m:g} is expected")
    return Board(
        section.integer("rows", 2, 200),
        section.integer("columns", 2, 200),
        spacing_m,
        dot_m,
        places_of(section, "tapes_in_board_m", "tape"),
    )


def places_of(section: Section, key: str, what: str) -> dict[str, FloatArray]:
    """Read at least three named points that no two share and that are not on one line."""
    names = section.mapping(key)
    for name in names:
        if not name.strip() or not name.isprintable():
            raise section.bad(key, f"{name[:40]!r} where the name of a {what} is expected")
    if len(names) < 3:
        raise section.bad(key, f"{len(names)} {what}s where at least three are expected")
    inner = section.section(key, tuple(names))
    places = {name: inner.vector(name, FURTHEST_M) for name in names}
    table = np.array(list(places.values()))
    across = np.linalg.svd(table - table.mean(axis=0), compute_uv=False)
    if across[1] < 1e-3 * max(across[0], 1e-3):
        raise section.bad(key, f"the {what}s stand on one line; no pose follows from them")
    for place in places.values():
        place.setflags(write=False)
    return places


def sigma_of(section: Section) -> Sigma:
    optional = {key: section.between(key, 0.0, 10.0, 0.0) for key in ("joint_rad", "prism_cad_m")}
    return Sigma(
        section.positive("station_m", FURTHEST_M), section.positive("dot_px", FURTHEST_M), **optional
    )


def bench_sigma_of(section: Section) -> Sigma:
    joint_rad = section.between("joint_rad", 0.0, 10.0, 0.0)
    return Sigma(0.0, 0.0, joint_rad, corner_px=section.positive("corner_px", FURTHEST_M))


def cameras_of(top: Section) -> dict[str, SurveyCamera]:
    cameras: dict[str, SurveyCamera] = {}
    for name in top.mapping("cameras"):
        if not CAMERA_NAME.fullmatch(name):
            raise top.bad(f"cameras.{name}", CAMERA_NAME_WORDS)
        value: Any = top.mapping("cameras")[name]
        place = f"cameras.{name}"
        section = Section(
            top.path, place, value, ("on", "size_px", "model", "focal_px"), ("rough", "sensor_mode")
        )
        width, height = section.integers("size_px", 2, 1, LARGEST_IMAGE_PX)
        camera: dict[str, Any] = {}
        if "rough" in section:
            rough = section.section("rough", ("C", "A"))
            camera["rough_C_m"], axis = rough.vector("C", FURTHEST_M), rough.vector("A")
            length = float(np.linalg.norm(axis))
            if length < 1e-6:
                raise rough.bad("A", "is zero where a direction is expected")
            camera["rough_A"] = axis / length
        cameras[name] = SurveyCamera(
            name=name,
            on=cast(Literal["head", "rover"], section.choice("on", ("head", "rover"))),
            size_px=(width, height),
            kind=cast(Kind, section.choice("model", FITTED)),
            focal_px=section.positive("focal_px", FURTHEST_M),
            sensor_mode=read_sensor_mode(section, (width, height)),
            **camera,
        )
    if not cameras:
        raise top.bad("cameras", "holds no camera; at least one is expected")
    return cameras
