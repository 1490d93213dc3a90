"""Tables for people, in a terminal and on a page, and the numbers in their cells."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

# How a cell with a number begins; a lone dash stands for a number that there is not.
_NUMBER = re.compile(r"[-+±]? ?\.?\d|[-–—]$|nan$")


class Table(NamedTuple):
    """Headings, and rows of as many cells."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]

    def turned(self) -> Table:
        """Return it with rows and columns exchanged: a column a distance fits a terminal of 80 columns."""
        columns = [list(column) for column in zip(self.headings, *self.rows, strict=True)]
        return Table(columns[0], columns[1:])

    @property
    def numeric(self) -> list[bool]:
        """Whether each column holds numbers alone, and stands to the right."""
        columns = zip(*self.rows, strict=True) if self.rows else [()] * len(self.headings)
        return [all(_NUMBER.match(cell) for cell in cells if cell) for cells in columns]


def number(value: float | None, digits: int = 2) -> str:
    """Return a number for a cell; empty for what is unknown or not finite."""
    return "" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def x_y(value: Iterable[float] | None, digits: int = 2) -> str:
    """Return x and y for a cell; empty for what is unknown."""
    return "" if value is None else ", ".join(f"{one:.{digits}f}" for one in value)
