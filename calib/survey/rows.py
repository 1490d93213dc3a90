"""Rows of a survey's CSV files: words and numbers, each refused with its file, line and column."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from calib.errors import BadFile
from calib.files.strict import nearest
from calib.files.tables import NUMBER, check_header

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
