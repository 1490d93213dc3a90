"""Self-contained HTML pages from the templates beside this module: one look, light, dark and on paper.

The templates hold the words and their order, Python the numbers. Everything that is put in is escaped;
nothing refers to a file or an address outside the page.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import ChoiceLoader, Environment, FileSystemLoader, PackageLoader, StrictUndefined


@dataclass(frozen=True)
class Badge:
    """A word on a coloured ground: ``simulated``, ``real``, ``good``, ``care``, ``bad``; others are grey."""

    word: str
    kind: str = ""


def page(template: str | Path, **told: Any) -> str:
    """Return a whole page.

    Parameters
    ----------
    template
        A file of the folder ``templates``; by its path, one from elsewhere that builds on these.
    told
        For the head ``title`` (words), ``badge`` (`Badge`) and ``facts`` (pairs of words); then all that the
        template names itself.
    """
    beside = None if isinstance(template, str) else template.parent
    return _templates(beside).get_template(Path(template).name).render(**told)


def of_daemon(status: Mapping[str, Any]) -> tuple[Badge, list[tuple[str, str]]]:
    """Return the badge and the first facts of a page on what a daemon did, by its status."""
    kind = str(status.get("hardware", "unknown"))
    mast = status.get("mast") or {}
    file = f"{mast.get('file', '')} ({str(mast.get('digest', ''))[:12]})"
    return Badge(kind.upper(), kind), [("hardware", kind), ("mast file", file)]


@cache
def _templates(beside: Path | None) -> Environment:
    """The templates, and those of another folder, strict about names that nobody gave."""
    own = PackageLoader("mastctl.report")
    return Environment(
        loader=own if beside is None else ChoiceLoader([FileSystemLoader(beside), own]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
