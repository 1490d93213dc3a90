"""The files of a survey folder: their bytes, the rows of their tables, the sizes of pictures, the digest."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from calib.errors import BadFile
from calib.files import JPEG_FRAMES, digest_of, jpeg_segments, open_plain, read_bytes, text_of
from calib.files.tables import NUMBER, check_header, csv_rows
from calib.files.yaml_text import MAX_BYTES, nearest
from calib.survey.records import SurveyCamera

MAX_ROWS = 2_000_000
CSV_MAX_BYTES = 200_000_000

EDGE_PX = 1.0
"""How far outside its image a dot or corner may have been found: noise at the border."""


def _picture_size_px(data: bytes) -> tuple[int, int] | None:
    """Return (width, height); None where the bytes are no whole picture.

    PNG and JPEG say it in their heads; others, such as TIFF, PGM and BMP, are decoded.
    """
    from calib.files.pictures import PNG_BEGINS, decode_picture  # OpenCV, which numbers do without

    if data.startswith(PNG_BEGINS) and data[12:16] == b"IHDR" and len(data) >= 24:
        return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    if data.startswith(b"\xff\xd8"):
        for marker, at in jpeg_segments(data):
            if marker in JPEG_FRAMES:  # ISO 10918-1, B.2.2: precision, height, width
                height, width = struct.unpack_from(">HH", data, at + 1)
                return width, height
        return None
    try:
        height, width = decode_picture(data).shape[:2]
    except ValueError:
        return None
    return width, height


class TableRow:
    """One row of a table; ``line`` counts from 1, the header's line."""

    def __init__(self, path: Path, line: int, cells: Mapping[str, str]) -> None:
        self.path, self.line, self.cells = path, line, cells

    def bad(self, column: str, reason: str) -> BadFile:
        """Return the refusal of a cell, or of the whole row for the column ''."""
        return BadFile(self.path, f"line {self.line}, {column}" if column else f"line {self.line}", reason)

    def text(self, column: str) -> str:
        """Return a cell that must not be empty."""
        cell = self.cells[column]
        if not cell:
            raise self.bad(column, "is empty; a name is expected")
        if not cell.isprintable():
            raise self.bad(column, f"{cell[:40]!r} where printable text is expected")
        return cell

    def choice(self, column: str, choices: Sequence[str], what: str) -> str:
        """Return a cell that must be one of the choices; ``what`` says what these are."""
        cell = self.text(column)
        if cell not in choices:
            raise self.bad(column, f"'{cell[:40]}' is no {what}; {nearest(cell, list(choices))}")
        return cell

    def number(self, column: str, limit: float) -> float:
        """Return a cell that must be a finite number of at most ``limit`` in size."""
        cell = self.cells[column]
        if not NUMBER.fullmatch(cell):
            raise self.bad(column, f"'{cell[:40]}' where a number is expected")
        value = float(cell)
        if not math.isfinite(value) or abs(value) > limit:
            raise self.bad(column, f"{cell[:40]} where a finite number up to {limit:g} is expected")
        return value

    def index(self, column: str, count: int) -> int:
        """Return a cell that must be an integer from 0 to count - 1."""
        value = self.number(column, 1e9)
        if value != int(value) or not 0 <= value < count:
            cell = self.cells[column][:40]
            raise self.bad(column, f"{cell} where an integer from 0 to {count - 1} is expected")
        return int(value)

    def pixel(self, camera: SurveyCamera) -> tuple[float, float]:
        """Return ``x_px`` and ``y_px``, which must be inside the camera's image."""
        pixel = self.number("x_px", 1e9), self.number("y_px", 1e9)
        for column, value, size in zip(("x_px", "y_px"), pixel, camera.size_px, strict=True):
            if not -0.5 - EDGE_PX <= value <= size - 0.5 + EDGE_PX:
                shape = "x".join(map(str, camera.size_px))
                raise self.bad(column, f"{value:g} is outside the image of {camera.name}, {shape} pixels")
        return pixel

    def none_on_body(self, column: str, camera: SurveyCamera) -> None:
        """Refuse a joint's cell that is not empty for a camera on the body."""
        cell = self.cells.get(column, "")
        if camera.on == "rover" and cell:
            raise self.bad(column, f"'{cell[:40]}' where nothing is expected: {camera.name} is on the body")


class Once:
    """Refuses what is in a table a second time."""

    def __init__(self) -> None:
        self._lines: dict[tuple[object, ...], int] = {}

    def __call__(self, row: TableRow, what: str, *key: object) -> None:
        if key in self._lines:
            raise row.bad("", f"{what} is there twice, first on line {self._lines[key]}")
        self._lines[key] = row.line


class SurveyFolder:
    """One reading of a folder; remembers what it read for the digest."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._digests: dict[str, str] = {}

    def document(self) -> bytes:
        """Return the bytes of survey.yaml."""
        if not self.path.is_dir():
            raise BadFile(self.path, "", "is no folder; a survey is a folder with survey.yaml in it")
        return self._bytes_of("survey.yaml", MAX_BYTES)

    def _bytes_of(self, name: str, limit_bytes: int) -> bytes:
        path = self.path / name
        if not path.exists():
            raise BadFile(path, "", "is missing; a survey has survey.yaml, station.csv and images.csv")
        data = read_bytes(path, limit_bytes)
        self._digests[name] = digest_of(data)
        return data

    def rows(
        self,
        name: str,
        columns: Sequence[str],
        may_be_there: Sequence[str] | None = None,
        required: bool = False,
    ) -> Iterator[TableRow]:
        """Yield a table's rows, none of one that is not there and not required; blanks around a cell go.

        ``columns`` are exactly these in this order; or, with ``may_be_there``, these and any of those, in any
        order. Raises BadFile for what is no UTF-8 CSV with such columns, and for a row of another length.
        """
        path = self.path / name
        if not required and not path.exists():
            return
        rows = csv_rows(text_of(self._bytes_of(name, CSV_MAX_BYTES), path), path)
        header = check_header(next(rows, (1, []))[1], path, columns, may_be_there)
        for count, (line, cells) in enumerate(rows):
            if count == MAX_ROWS:
                raise BadFile(path, "", f"has more than {MAX_ROWS} rows, the most that is read")
            if len(cells) != len(header):
                raise BadFile(path, f"line {line}", f"{len(cells)} cells where {len(header)} are expected")
            yield TableRow(path, line, dict(zip(header, map(str.strip, cells), strict=True)))

    def check_picture(self, row: TableRow, file: str, camera: SurveyCamera) -> None:
        """Refuse a picture of another size, and note its content; one that is missing is for the check."""
        path = self.path / file
        try:
            if not path.is_file():
                return
            with open_plain(path) as stream:
                data = stream.read()
            size_px = _picture_size_px(data)
            self._digests[file] = digest_of(data)
        except (OSError, ValueError) as error:
            raise row.bad("file", f"'{file[:60]}' cannot be read: {error}") from None
        if size_px is not None and size_px != camera.size_px:
            found, wanted = ("x".join(map(str, size)) for size in (size_px, camera.size_px))
            raise row.bad("file", f"{file} is {found} pixels where {camera.name} of survey.yaml has {wanted}")

    def digest(self) -> str:
        """Return the SHA-256 over names and contents of all that was read."""
        listing = "".join(f"{digest}  {name}\n" for name, digest in sorted(self._digests.items()))
        return digest_of(listing.encode("utf-8", "surrogatepass"))
