"""What a run leaves: self-contained HTML pages, and for programs tables as CSV and records as JSON.

Templates beside this module have the text and its order, Python the numbers: one look, light, dark and on
paper. Everything that is put in is escaped; nothing refers to a file or an address outside the page.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import ChoiceLoader, Environment, FileSystemLoader, PackageLoader, StrictUndefined


@dataclass(frozen=True)
class Badge:
    """A word on a coloured ground: ``simulated``, ``real``, ``good``, ``care``, ``bad``; others are grey."""

    word: str
    kind: str = ""


def page(template: str | Path, **values: Any) -> str:
    """Return a whole page from a file of ``templates``, or, by its path, one that builds on these.

    Its head needs ``title``, ``badge`` (`Badge`) and ``facts`` (pairs of texts); the rest is the template's
    own.
    """
    beside = None if isinstance(template, str) else template.parent
    return _templates(beside).get_template(Path(template).name).render(**values)


def of_daemon(status: Mapping[str, Any]) -> tuple[Badge, list[tuple[str, str]]]:
    """Return the badge and the first facts of a page on what a daemon did, by its status."""
    kind = str(status.get("hardware", "unknown"))
    mast = status.get("mast") or {}
    file = f"{mast.get('file', '')} ({str(mast.get('digest', ''))[:12]})"
    return Badge(kind.upper(), kind), [("hardware", kind), ("mast file", file)]


@cache
def _templates(beside: Path | None) -> Environment:
    """The templates, and those of another folder, strict about unknown names."""
    own = PackageLoader("mastctl.report")
    return Environment(
        loader=own if beside is None else ChoiceLoader([FileSystemLoader(beside), own]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a table: numbers in shortest form, cells of what is not a number empty. Raises OSError."""
    with path.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([_cell(value) for value in row] for row in rows)


def _cell(value: Any) -> str:
    if isinstance(value, (float, np.floating)):
        return "" if math.isnan(value) else repr(float(value))
    return str(value)


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write a record, a line a value. Raises OSError."""
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
