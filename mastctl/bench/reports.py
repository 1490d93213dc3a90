"""The reports that a daemon shows: those of its runs, and what lies in ``reports`` of its state folder.

A report is found by its name in the list of what is there; no path is ever made of a requested name.
"""

from __future__ import annotations

import html
import re
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from calib.errors import BadFile
from calib.files import is_plain_file, read_bytes
from mastctl.answers import ReportSummary
from mastctl.bench.runs import Runs
from mastctl.errors import NotKnown

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
SHOWN = 100
LARGEST_BYTES = 50_000_000
_TITLE = re.compile(rb"<title>([^<]{1,300})</title>")


class Reports:
    """The reports of one daemon."""

    def __init__(self, state: Path, runs: Runs) -> None:
        self.folder = state / "reports"
        self._runs = runs

    def summaries(self) -> list[ReportSummary]:
        """Return their names, titles and when they were written (ISO 8601, UTC), the newest first."""
        found = {name: path for name, path in self._files() if NAME.fullmatch(name)}
        reports = [one for name, path in found.items() if (one := _summary(name, path)) is not None]
        return sorted(reports, key=lambda one: one["written"], reverse=True)[:SHOWN]

    def page(self, name: str) -> bytes:
        """Return a report's HTML.

        Raises
        ------
        NotKnown
            ``report_unknown``.
        """
        path = next((path for known, path in self._files() if known == name and NAME.fullmatch(known)), None)
        if path is None or not _is_own(path):
            raise NotKnown("report_unknown", f"there is no report '{name[:60]}'")
        try:
            return read_bytes(path, LARGEST_BYTES)
        except BadFile as error:
            raise NotKnown("report_unknown", f"report '{name[:60]}': {error.reason}") from None

    def _files(self) -> Iterator[tuple[str, Path]]:
        """Each report's name and file; later ones of a name that was there are passed over by the caller."""
        for run in self._runs.all():
            yield run.name, run.page
        for path in _entries(self.folder):
            if path.suffix == ".html":
                yield path.name, path
            elif path.is_dir() and not path.is_symlink():
                yield from (
                    (f"{path.name}.{one.name}", one) for one in _entries(path) if one.suffix == ".html"
                )


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []


def _is_own(path: Path) -> bool:
    """Whether it is a file where it seems to be, and no link to elsewhere."""
    return is_plain_file(path) and not path.is_symlink()


def _summary(name: str, path: Path) -> ReportSummary | None:
    if not _is_own(path):
        return None
    try:
        with path.open("rb") as file:
            head = file.read(4096)
        written = datetime.fromtimestamp(path.stat().st_mtime, UTC).isoformat(timespec="seconds")
    except OSError:
        return None
    found = _TITLE.search(head)
    title = html.unescape(found[1].decode(errors="replace")) if found else name
    return {"name": name, "title": " ".join(title.split()), "written": written}
