"""The folders of bench calibrations, below ``bench`` in the daemon's state folder.

20261122-184501/run.json       the run's record, as it began or as it ended
                board.yaml     the board
                seen/          the survey, and the run's journal
                report/        bench.html

A run is found by its name in the list of those that exist; no path is ever made of a requested name.
"""

from __future__ import annotations

import re
import shutil
from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from calib.errors import BadFile
from calib.files import read_bytes
from calib.targets.board_file import parse_board
from calib.targets.boards import AnyBoard
from mastctl.answers import BenchRunRecord, BenchSummary
from mastctl.errors import BadRequest, NotKnown, Unable
from mastctl.packaged import config_folder
from mastctl.safety.state_folder import StateFile

NAME = re.compile(r"[0-9]{8}-[0-9]{6}(-[0-9]{1,3})?")
SCHEMA = "mastctl/bench_run/2"
SHOWN = 50
MOST_BOARD_BYTES, MOST_REPORT_BYTES = 100_000, 50_000_000

HOLDER = "bench calibration"
"""The name of a worker as a client of its daemon."""


def new_record(name: str, by: str, board: str, simulated: bool, **wanted: Any) -> BenchRunRecord:
    """Return a run as it begins; ``wanted`` replaces what is usual."""
    usual: dict[str, Any] = {
        "begun": datetime.now(UTC).isoformat(timespec="seconds"), "state": "running", "step": "begin",
        "code": None, "sentence": "", "by_hand": False, "wanted_px": 0.2, "board_m": None, "requested": None,
        "placements": 0, "pictures": 0, "most": 60, "predicted_px": None, "target_px": None,
        "counts_px": None, "expected_px": None, "next_rad": None, "cameras": {}, "curve": [], "sentences": [],
        "result": None, "mast_file": None, "report": None,
    }  # fmt: skip
    return {"name": name, "by": by, "board": board, "simulated": simulated, **(usual | wanted)}  # type: ignore[typeddict-item]


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
    def page(self) -> Path:
        """The report."""
        return self.path / "report" / "bench.html"

    def read(self) -> BenchRunRecord:
        """Return run.json. Raises BadFile."""
        file = StateFile(self.path / "run.json", SCHEMA)
        try:
            return TypeAdapter(BenchRunRecord).validate_python(file.read())
        except ValidationError as error:
            first = error.errors()[0]
            place = ".".join(map(str, first["loc"]))
            raise BadFile(file.path, place, f"{first['msg']}: it is no run's record") from None

    def write(self, run: BenchRunRecord) -> None:
        """Write run.json. Raises BadFile."""
        StateFile(self.path / "run.json", SCHEMA).write(run)

    def summary(self) -> BenchSummary:
        """Return the run as the list of runs has it; of a damaged one that it is."""
        run: dict[str, Any] = {"result": None, "mast_file": None, "begun": "", "by": "", "board": ""}
        try:
            run |= self.read()
        except BadFile as error:
            run |= {"state": "damaged", "sentence": str(error)}
        if run["state"] in ("running", "waiting"):
            cut_off = "it was cut off: the daemon or its machine ended meanwhile"
            run |= {"state": "interrupted", "sentence": cut_off}
        try:
            sizes = {one.name: one.stat().st_size for one in (self.seen / "images").iterdir()}
        except OSError:
            sizes = {}
        cameras = Counter(name.removesuffix(".png").split("-", 2)[-1] for name in sizes)
        return {
            "name": self.name,
            "begun": run["begun"],
            "by": run["by"],
            "board": run["board"],
            "state": run["state"],
            "sentence": run["sentence"],
            "pictures": max(cameras.values(), default=0),
            "size_mb": sum(sizes.values()) / 1e6,
            "grade": None if run["result"] is None else run["result"]["verdict"]["grade"],
            "mast_file": run["mast_file"],
            "report": self.name if self.page.is_file() else None,
        }


@dataclass(frozen=True)
class BenchJob:
    """What a worker needs: the run as it begins with its folder, the mast file to make, and the daemon with
    the lease and the token to steer it."""

    run: BenchRunRecord
    folder: RunFiles
    out: Path
    url: str
    lease_id: str
    token: str | None


class Runs:
    """All runs of one daemon."""

    def __init__(self, state: Path) -> None:
        self.folder = state / "bench"

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
        try:
            found = sorted(self.folder.iterdir(), reverse=True)
        except OSError:
            return []
        return [
            RunFiles(one)
            for one in found
            if NAME.fullmatch(one.name) and not one.is_symlink() and (one / "run.json").is_file()
        ]

    def report(self, name: str) -> bytes:
        """Return the HTML of a run's report. Raises NotKnown ``bench_unknown``, ``report_unknown``."""
        try:
            return read_bytes(self.named(name).page, MOST_REPORT_BYTES)
        except BadFile as error:
            raise NotKnown("report_unknown", f"run {name} has no report: {error.reason}") from None


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
