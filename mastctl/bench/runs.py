"""The folders of runs, below ``bench`` in the daemon's state folder, and the reports that a daemon shows.

20261122-184501/run.json       the request (client, time, what is wanted, the mast file to make) and, under
                               ``end``, how it ended; without it it was cut off
                board.yaml     the board
                seen/          the survey, and the run's journal
                report/        bench.html

Other reports lie in ``reports`` of the state folder. A run or report is found by its name in the list of
those that exist; no path is ever made of a requested name.
"""

from __future__ import annotations

import html
import re
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from calib.errors import BadFile
from calib.files import is_plain_file, read_bytes
from calib.targets.board_file import parse_board
from calib.targets.boards import AnyBoard
from mastctl.answers import BenchRunRecord, BenchSummary, ReportSummary
from mastctl.errors import BadRequest, NotKnown, Unable
from mastctl.packaged import config_folder
from mastctl.safety.state_folder import StateFile

NAME = re.compile(r"[0-9]{8}-[0-9]{6}(-[0-9]{1,3})?")
REPORT_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
SCHEMA = "mastctl/bench_run/1"
SHOWN, REPORTS_SHOWN = 50, 100
MOST_BOARD_BYTES, MOST_REPORT_BYTES = 100_000, 50_000_000
_TITLE = re.compile(rb"<title>([^<]{1,300})</title>")


HOLDER = "bench calibration"
"""The name of a worker as a client of its daemon."""


@dataclass(frozen=True)
class BenchJob:
    """What a worker needs: the run as it begins, the daemon with the lease and token to steer it, files."""

    run: BenchRunRecord
    url: str
    lease_id: str
    token: str | None
    board: Path
    survey: Path
    out: Path
    report: Path


def new_record(name: str, request: Mapping[str, Any], simulated: bool) -> BenchRunRecord:
    """Return a run as it begins; ``request`` as in its folder's run.json."""
    return {
        "name": name, "begun": request["begun"], "by": request["by"], "state": "running", "step": "begin",
        "code": None, "sentence": "", "simulated": simulated, "by_hand": request["by_hand"],
        "wanted_px": request["wanted_px"], "board_m": None, "requested": None, "placements": 0, "pictures": 0,
        "most": request["pictures"], "predicted_px": None, "target_px": None, "counts_px": None,
        "expected_px": None, "next_rad": None, "cameras": {}, "curve": [], "sentences": [], "result": None,
        "mast_file": None, "report": None,
    }  # fmt: skip


@dataclass(frozen=True)
class RunFiles:
    """The folder of one run."""

    path: Path

    @property
    def name(self) -> str:
        """Its name, by which clients request it."""
        return self.path.name

    @property
    def board(self) -> Path:
        """The board's file."""
        return self.path / "board.yaml"

    @property
    def seen(self) -> Path:
        """The survey."""
        return self.path / "seen"

    @property
    def report(self) -> Path:
        """The report's folder."""
        return self.path / "report"

    @property
    def page(self) -> Path:
        """The report."""
        return self.report / "bench.html"

    def read(self) -> dict[str, Any]:
        """Return run.json. Raises BadFile."""
        document = StateFile(self.path / "run.json", SCHEMA).read()
        if document is None:
            raise BadFile(self.path / "run.json", "", "is missing: this is no run's folder")
        return document

    def write(self, request: Mapping[str, Any], ended: BenchRunRecord | None = None) -> None:
        """Write run.json: what is requested, and how the run has ended. Raises BadFile."""
        document = dict(request)
        if ended is not None:
            document["end"] = {
                **{key: ended[key] for key in ("state", "code", "sentence")},
                "grade": None if ended["result"] is None else ended["result"]["verdict"]["grade"],
                "at": datetime.now(UTC).isoformat(timespec="seconds"),
            }  # fmt: skip
        StateFile(self.path / "run.json", SCHEMA).write(document)

    def summary(self) -> BenchSummary:
        """Return the run as the list of runs has it; of a damaged one that it is."""
        request: Mapping[str, Any] = {}
        try:
            request = self.read()
            end = request.get("end") or {
                "state": "interrupted",
                "sentence": "it was cut off: the daemon or its machine ended meanwhile",
            }
        except BadFile as error:
            end = {"state": "damaged", "sentence": str(error)}
        try:
            sizes = {one.name: one.stat().st_size for one in (self.seen / "images").iterdir()}
        except OSError:
            sizes = {}
        cameras = Counter(name.removesuffix(".png").split("-", 2)[-1] for name in sizes)
        return {
            "name": self.name,
            "begun": str(request.get("begun", "")),
            "by": str(request.get("by", "")),
            "board": str(request.get("board", "")),
            "state": end["state"],
            "sentence": str(end["sentence"]),
            "pictures": max(cameras.values(), default=0),
            "size_mb": sum(sizes.values()) / 1e6,
            "grade": end.get("grade"),
            "mast_file": request.get("mast_file") if end["state"] == "done" else None,
            "report": self.name if self.page.is_file() else None,
        }


class Runs:
    """All runs and reports of one daemon."""

    def __init__(self, state: Path) -> None:
        self.folder, self.reports_folder = state / "bench", state / "reports"

    def new(self) -> RunFiles:
        """Make a folder for a run that begins now. Raises Unable ``unwritable``."""
        stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
        for name in (stamp, *(f"{stamp}-{k}" for k in range(2, 1000))):
            try:
                (self.folder / name).mkdir(parents=True)
            except FileExistsError:
                continue
            except OSError as error:
                raise _unwritable(f"a run's folder cannot be made in {self.folder}", error) from None
            return RunFiles(self.folder / name)
        raise Unable("unwritable", f"no name is free in {self.folder}")

    def named(self, name: str) -> RunFiles:
        """Return a run by its name. Raises NotKnown ``bench_unknown``."""
        for one in self.all():
            if one.name == name:
                return one
        raise NotKnown("bench_unknown", f"there is no run '{name[:60]}' in {self.folder}")

    def forget(self, name: str) -> None:
        """Remove a run's folder. Raises NotKnown ``bench_unknown``, Unable ``unwritable``."""
        folder = self.named(name).path
        going = folder.with_name(f"{name}.removed")  # a half of it is no run
        try:
            shutil.rmtree(folder.rename(going))
        except OSError as error:
            left = going if going.exists() else folder
            raise _unwritable(f"{left} cannot be removed", error) from None

    def all(self) -> list[RunFiles]:
        """Return all, the newest first. What is no run's folder, or a link, is passed over."""
        return [
            RunFiles(one)
            for one in reversed(_entries(self.folder))
            if NAME.fullmatch(one.name) and not one.is_symlink() and (one / "run.json").is_file()
        ]

    def summaries(self) -> Iterator[BenchSummary]:
        """Yield the newest runs as the list of runs has them."""
        return (one.summary() for one in self.all()[:SHOWN])

    def reports(self) -> list[ReportSummary]:
        """Return the reports' names, titles and when they were written (ISO 8601, UTC), the newest first."""
        found = [one for name, path in self._reports().items() if (one := _report_summary(name, path))]
        return sorted(found, key=lambda one: one["written"], reverse=True)[:REPORTS_SHOWN]

    def report(self, name: str) -> bytes:
        """Return a report's HTML. Raises NotKnown ``report_unknown``."""
        path = self._reports().get(name)
        if path is None:
            raise NotKnown("report_unknown", f"there is no report '{name[:60]}'")
        try:
            return read_bytes(path, MOST_REPORT_BYTES)
        except BadFile as error:
            raise NotKnown("report_unknown", f"report '{name[:60]}': {error.reason}") from None

    def _reports(self) -> dict[str, Path]:
        """Each report's name and file; what is a link to elsewhere is none."""
        found = {run.name: run.page for run in self.all()}
        for path in _entries(self.reports_folder):
            inside = [] if path.is_symlink() else _entries(path)
            for name, file in ((path.name, path), *((f"{path.name}.{one.name}", one) for one in inside)):
                if file.suffix == ".html":
                    found.setdefault(name, file)
        return {
            name: file
            for name, file in found.items()
            if REPORT_NAME.fullmatch(name) and is_plain_file(file) and not file.is_symlink()
        }


def known_boards() -> dict[str, Path]:
    """Return the boards that are packaged, by name."""
    return {path.stem: path for path in sorted((config_folder() / "boards").glob("*.yaml"))}


def board_bytes(known: str | None, text: str | None) -> tuple[bytes, AnyBoard]:
    """Return a BOARD.yaml and its board: a packaged one, or that of a text.

    Raises BadRequest ``bad_board`` with the place and what is expected.
    """
    try:
        if text is not None:
            data, place = text.encode("utf-8", "surrogatepass"), Path("board_file")
        else:
            boards = known_boards()
            if known not in boards:
                reason = f"there is no board '{str(known)[:60]}'; there are {', '.join(boards)}"
                raise BadRequest("bad_board", reason)
            place = boards[known]
            data = read_bytes(place, MOST_BOARD_BYTES)
        return data, parse_board(data, place)
    except BadFile as error:
        raise BadRequest("bad_board", " ".join(f"{error.place or 'board'}: {error.reason}".split())) from None


def _unwritable(place: str, error: OSError) -> Unable:
    return Unable("unwritable", f"{place}: {error.strerror or error}")


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []


def _report_summary(name: str, path: Path) -> ReportSummary | None:
    try:
        with path.open("rb") as file:
            head = file.read(4096)
        written = datetime.fromtimestamp(path.stat().st_mtime, UTC).isoformat(timespec="seconds")
    except OSError:
        return None
    found = _TITLE.search(head)
    title = html.unescape(found[1].decode(errors="replace")) if found else name
    return {"name": name, "title": " ".join(title.split()), "written": written}
