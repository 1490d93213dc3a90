"""Tables of numbers as CSV: points and pixels in, points, pixels and rays out.

In: UTF-8, with or without a byte-order mark, any line ends. The first line names the columns exactly. A cell
is a number, ``nan`` and ``inf`` included. A row of empty cells is a row of not-a-numbers, as this module
writes them. Out: a header, one row an input row, shortest round-trip numbers, empty cells where there is no
number.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TextIO

import numpy as np

from calib.errors import BadFile
from calib.files import read_bytes, text_of
from calib.files.yaml_text import nearest
from calib.geometry.rigid import FloatArray

NUMBER = re.compile(
    r"[-+]?(?:(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|inf|infinity|nan)", re.IGNORECASE
)
_OTHER_DELIMITERS = {";": "';'", "\t": "tab", "|": "'|'"}


def read_table(path: str | Path, columns: Sequence[str]) -> FloatArray:
    """Return the table's numbers as (rows, columns); the header must name these columns in this order.

    Raises BadFile for another header, a row of another length, or a cell that is not a number. The place is
    the row, counted from 1 after the header, and the line of the file.
    """
    return parse_table(read_bytes(path, 1 << 29), path, columns)


def parse_table(data: bytes, path: str | Path, columns: Sequence[str]) -> FloatArray:
    """Return the numbers of a table's bytes; ``path`` is for messages. Raises BadFile as ``read_table``."""
    text = text_of(data, path)
    # Python's float reads 1_000 and digits of other scripts too; without them it knows just our numbers.
    float_is_strict = text.isascii() and text.count("_") == sum(name.count("_") for name in columns)
    values: list[list[float]] = []
    rows = csv_rows(text, path)
    check_header(next(rows, (1, []))[1], path, columns)
    for line, cells in rows:
        if float_is_strict and len(cells) == len(columns):
            try:
                values.append([float(cell) for cell in cells])
                continue
            except ValueError:
                pass
        values.append(_numbers(TableRow(path, f"row {len(values) + 1} (line {line})", columns, cells)))
    return np.array(values, dtype=np.float64).reshape(len(values), len(columns))


def csv_rows(text: str, path: str | Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the line and the cells of each row, the header first; blank lines may follow the last alone.

    Raises BadFile as `read_table`.
    """
    lines = csv.reader(io.StringIO(text, newline=""), strict=True)
    blank_line = 0
    try:
        for cells in lines:
            if not cells and lines.line_num > 1:
                blank_line = blank_line or lines.line_num
                continue
            if blank_line:
                raise BadFile(path, f"line {blank_line}", "is blank; a row is expected on every line")
            yield lines.line_num, cells
    except csv.Error as error:
        raise BadFile(path, f"line {lines.line_num}", f"is not CSV: {error}") from None


def write_table(stream: TextIO, columns: Sequence[str], values: FloatArray) -> None:
    """Write (rows, columns) numbers as CSV; a row with a number that is not finite becomes empty cells."""
    finite = np.logical_and.reduce(np.isfinite(values), axis=1).tolist()
    empty = [""] * len(columns)
    write_rows(
        stream, columns, (row if good else empty for row, good in zip(values.tolist(), finite, strict=True))
    )


def write_rows(stream: TextIO, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a header and rows as CSV: numbers in shortest round-trip form, None as an empty cell."""
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)


def check_header(
    cells: Sequence[str], path: str | Path, columns: Sequence[str], optional: Sequence[str] | None = None
) -> list[str]:
    """Return the names of a header: exactly these, or in any order these and perhaps some optional ones.

    Raises BadFile.
    """
    found = [cell.strip() for cell in cells]
    if found == list(columns):
        return found
    expected = ",".join(columns)
    joined = ",".join(found)
    for delimiter, name in _OTHER_DELIMITERS.items():
        if [part.strip() for part in joined.split(delimiter)] == list(columns):
            raise BadFile(path, "line 1", f"the columns are separated by {name}; expected '{expected}'")
    if optional is None or not set(found) & set(columns):
        raise BadFile(path, "line 1", f"the header is '{joined[:60]}'; expected '{expected}'")
    known = [*columns, *optional]
    for name in (*found, *columns):
        if name not in known:
            raise BadFile(path, "line 1", f"'{name[:40]}' is no column; {nearest(name, known)}")
        if found.count(name) != 1:
            what = f"column {name} is there twice" if name in found else f"there is no column {name}"
            raise BadFile(path, "line 1", f"{what}; expected '{expected}'")
    return found


class TableRow:
    """One row of a table; ``place`` names it in refusals. Blanks around a cell go.

    Raises BadFile where there are more or fewer cells than columns.
    """

    def __init__(self, path: str | Path, place: str, columns: Sequence[str], cells: Sequence[str]) -> None:
        self.path, self.place = path, place
        if len(cells) != len(columns):
            raise self.bad("", f"{len(cells)} cells where {len(columns)} are expected")
        self.cells = dict(zip(columns, map(str.strip, cells), strict=True))

    def bad(self, column: str, reason: str) -> BadFile:
        """Return the refusal of a cell, or of the whole row for the column ''."""
        return BadFile(self.path, f"{self.place}, {column}" if column else self.place, reason)

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

    def number(self, column: str, limit: float = math.inf) -> float:
        """Return a cell that must be a number, a finite one of at most ``limit`` in size if that is given."""
        cell = self.cells[column]
        if not NUMBER.fullmatch(cell):
            raise self.bad(column, f"'{cell[:40]}' where a number is expected")
        value = float(cell)
        if math.isfinite(limit) and not abs(value) <= limit:
            raise self.bad(column, f"{cell[:40]} where a finite number up to {limit:g} is expected")
        return value

    def index(self, column: str, count: int) -> int:
        """Return a cell that must be an integer from 0 to count - 1."""
        value = self.number(column, 1e9)
        if value != int(value) or not 0 <= value < count:
            cell = self.cells[column][:40]
            raise self.bad(column, f"{cell} where an integer from 0 to {count - 1} is expected")
        return int(value)


def _numbers(row: TableRow) -> list[float]:
    if not any(row.cells.values()):
        return [math.nan] * len(row.cells)
    return [row.number(column) for column in row.cells]
