"""The folders of runs, below ``bench`` in the daemon's state folder: what was asked, seen, and came of it.

20261122-184501/run.json       who began it, when, what is wanted, which mast file it is to make
                board.yaml     the board
                seen/          the survey, and the run's journal
                report/        bench.html
                end.json       how it ended; not there: it was cut off
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from calib.errors import BadFile
from calib.files import read_bytes
from calib.files.atomic import replace_bytes
from calib.targets.board_file import parse_board
from calib.targets.boards import AnyBoard
from mastctl.answers import BenchListed
from mastctl.errors import BadRequest, NotKnown, Unable
from mastctl.guided.told import GuidedRun
from mastctl.packaged import config_folder
from mastctl.safety.state_file import StateFile

NAME = re.compile(r"[0-9]{8}-[0-9]{6}(-[0-9]{1,3})?")
SCHEMA, END_SCHEMA = "mastctl/guided/1", "mastctl/guided_end/1"
SHOWN = 50
MOST_BOARD_BYTES = 100_000


@dataclass(frozen=True)
class GuidedFolder:
    """The folder of one run."""

    path: Path

    @property
    def name(self) -> str:
        """Its name, by which it is asked for."""
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

    def asked(self) -> dict[str, Any]:
        """Return what was asked for. Raises BadFile."""
        told = StateFile(self.path / "run.json", SCHEMA).read()
        if told is None:
            raise BadFile(self.path / "run.json", "", "is not there: this is no run's folder")
        return told

    def end(self) -> dict[str, Any] | None:
        """Return how it ended, None if it was cut off. Raises BadFile."""
        return StateFile(self.path / "end.json", END_SCHEMA).read()

    def keep_asked(self, told: Mapping[str, Any]) -> None:
        """Write down what is asked for. Raises BadFile."""
        StateFile(self.path / "run.json", SCHEMA).write(told)

    def keep_end(self, run: GuidedRun) -> None:
        """Write down how it ended. Raises BadFile."""
        told = {
            "state": run.state,
            "code": run.code,
            "sentence": run.sentence,
            "pictures": run.pictures,
            "grade": None if run.result is None else run.result["verdict"]["grade"],
            "ended": datetime.now(UTC).isoformat(timespec="seconds"),
        }
        StateFile(self.path / "end.json", END_SCHEMA).write(told)

    def listed(self) -> BenchListed:
        """Return the run as the list of runs has it. Raises BadFile."""
        asked, end = self.asked(), self.end() or {}
        state: Any = str(end.get("state", "interrupted"))
        cut = "it was cut off: the daemon or its machine ended meanwhile"
        return {
            "name": self.name,
            "begun": str(asked.get("begun", "")),
            "by": str(asked.get("by", "")),
            "board": str(asked.get("board", "")),
            "state": state,
            "sentence": str(end.get("sentence", cut)),
            "pictures": _pictures(self.seen),
            "size_mb": _size_mb(self.seen),
            "grade": end.get("grade"),
            "mast_file": asked.get("mast_file") if state == "done" else None,
            "report": self.name if self.page.is_file() else None,
        }


class Runs:
    """All runs of one daemon."""

    def __init__(self, state: Path) -> None:
        self.folder = state / "bench"

    def new(self) -> GuidedFolder:
        """Make a folder for a run that begins now. Raises Unable ``unwritable``."""
        stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
        for name in (stamp, *(f"{stamp}-{k}" for k in range(2, 1000))):
            try:
                (self.folder / name).mkdir(parents=True)
            except FileExistsError:
                continue
            except OSError as error:
                words = f"a run's folder cannot be made in {self.folder}: {error.strerror or error}"
                raise Unable("unwritable", words) from None
            return GuidedFolder(self.folder / name)
        raise Unable("unwritable", f"no name is free in {self.folder}")

    def named(self, name: str) -> GuidedFolder:
        """Return a run that is there, by its name. Raises NotKnown ``bench_unknown``."""
        for one in self.all():
            if one.name == name:
                return one
        raise NotKnown("bench_unknown", f"there is no run '{name[:60]}' in {self.folder}")

    def forget(self, name: str) -> None:
        """Remove a run's folder. Raises NotKnown ``bench_unknown``, Unable ``unwritable``."""
        folder = self.named(name).path
        going = folder.with_name(f"{name}.removed")  # a half of it is no run
        try:
            folder.rename(going)
            shutil.rmtree(going)
        except OSError as error:
            left = going if going.exists() else folder
            raise Unable("unwritable", f"{left} cannot be removed: {error.strerror or error}") from None

    def all(self) -> list[GuidedFolder]:
        """Return all, the newest first. What is no run's folder, or a link, is passed over."""
        try:
            found = [one for one in self.folder.iterdir() if NAME.fullmatch(one.name)]
        except OSError:
            return []
        return [
            GuidedFolder(one)
            for one in sorted(found, reverse=True)
            if one.is_dir() and not one.is_symlink() and (one / "run.json").is_file()
        ]

    def listed(self) -> Iterator[BenchListed]:
        """Yield the newest as JSON; of a damaged one that it is."""
        for one in self.all()[:SHOWN]:
            try:
                yield one.listed()
            except BadFile as error:
                yield {
                    "name": one.name, "begun": "", "by": "", "board": "", "state": "damaged",
                    "sentence": str(error), "pictures": 0, "size_mb": 0.0, "grade": None,
                    "mast_file": None, "report": None,
                }  # fmt: skip


def known_boards() -> dict[str, Path]:
    """Return the boards that are packaged, by name."""
    return {path.stem: path for path in sorted((config_folder() / "boards").glob("*.yaml"))}


def board_bytes(known: str | None, text: str | None) -> tuple[bytes, AnyBoard]:
    """Return a BOARD.yaml and its board: a packaged one, or that of a text.

    Raises
    ------
    BadRequest
        ``bad_board`` with the place and what is expected.
    """
    try:
        if text is not None:
            data, place = text.encode("utf-8", "surrogatepass"), Path("board_file")
        else:
            boards = known_boards()
            if known not in boards:
                words = f"there is no board '{str(known)[:60]}'; there are {', '.join(boards)}"
                raise BadRequest("bad_board", words)
            place = boards[known]
            data = read_bytes(place, MOST_BOARD_BYTES)
        return data, parse_board(data, place)
    except BadFile as error:
        raise BadRequest("bad_board", " ".join(f"{error.place or 'board'}: {error.reason}".split())) from None


def keep_board(folder: GuidedFolder, data: bytes) -> None:
    """Write a board's file into a run's folder. Raises Unable ``unwritable``."""
    try:
        replace_bytes(folder.board, data, 0o644)
    except OSError as error:
        words = f"{folder.board} cannot be written: {error.strerror or error}"
        raise Unable("unwritable", words) from None


def _size_mb(seen: Path) -> float:
    """How large the pictures are, which are nearly all of a run."""
    try:
        return sum(one.stat().st_size for one in (seen / "images").iterdir()) / 1e6
    except OSError:
        return 0.0


def _pictures(seen: Path) -> int:
    """How many pictures the camera with most has, by the names of what lies there."""
    counts: dict[str, int] = {}
    try:
        for one in (seen / "images").iterdir():
            camera = one.stem.split("-", 2)[-1]
            counts[camera] = counts.get(camera, 0) + 1
    except OSError:
        return 0
    return max(counts.values(), default=0)
