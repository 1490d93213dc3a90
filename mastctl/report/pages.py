"""Self-contained HTML pages by templates, and the tables on them and in a terminal.

Templates beside this module have the text and its order, Python the numbers: light, dark and on paper.
Everything that is put in is escaped; nothing refers to a file or an address outside the page.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from jinja2 import Environment

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


@dataclass(frozen=True)
class Badge:
    """A word on a coloured ground: ``simulated``, ``real``, ``good``, ``care``, ``bad``; others are grey."""

    word: str
    kind: str = ""


def page(template: str, **values: Any) -> str:
    """Return a whole page from a file of ``templates``.

    Its head needs ``title``, ``badge`` (`Badge`) and ``facts`` (pairs of texts); the rest is the template's
    own.
    """
    return _templates().get_template(template).render(**values)


@cache
def _templates() -> Environment:
    """The templates, strict about unknown names."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("mastctl.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
