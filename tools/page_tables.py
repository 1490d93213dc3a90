"""Tables of a page that lie beside it as CSV files, which the site renders by the directive `data-table`."""

from __future__ import annotations

import csv
import re
from pathlib import Path

DIRECTIVE = re.compile(r"^```{data-table} (\S+)\n```$", re.MULTILINE)


def page_text(page: Path) -> str:
    """Return a page with its CSV files as tables in Markdown."""

    def table(directive: re.Match[str]) -> str:
        with _file(page, directive[1]).open(newline="") as file:
            head, *rows = csv.reader(file)
        return "\n".join(line_of(cells) for cells in (head, ["---"] * len(head), *rows))

    return DIRECTIVE.sub(table, page.read_text(encoding="utf-8"))


def _file(page: Path, name: str) -> Path:
    return page.parent / "data" / f"{name}.csv"


def line_of(cells: list[str]) -> str:
    """Return a row of a table in Markdown."""
    return f"| {' | '.join(cells)} |"


def cells_of(line: str) -> list[str]:
    """Return the cells of a row."""
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
