"""The folder of recordings: the ring's segments, what was kept at faults, and runs; each within its bound.

    ring/      000001-20261122T120341Z.mcap ...              overwritten in turn
    kept/      000001-20261122T120341Z-pan_tilt-no_reply/    segments of the ring, moved here at a fault
    runs/      20261122T120341Z-NAME.mcap                    begun and ended by command

Segments are moved, not copied: keeping them needs no space and no time, on a full disk either. Which of them
is older follows from their numbers and by the monotonic clock: the calendar may be set back, or ahead.
"""

from __future__ import annotations

import contextlib
import os
import re
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

from pydantic import Field

from calib.files import is_plain_file
from calib.files.records import ABSENT, PathInFile, Record
from mastctl.answers import RecordingKind, RecordingListed
from mastctl.as_json import readable

RING_S = 300.0
"""Of real hardware, unless the configuration says otherwise: five minutes before a fault."""


_Megabytes = Annotated[float, Field(ge=10.0, le=1e7)]


class RecordSettings(Record):
    """How much is recorded, 1 MB being 10⁶ bytes, and where.

    Without ``ring_s`` the ring is `RING_S` long if any device is real, and there is none otherwise; without
    ``folder`` recordings lie in ``records`` in the daemon's state folder.
    """

    ring_s: Annotated[float, Field(ge=0.0, le=86400.0)] = Field(
        default=ABSENT, description="length of the ring that is kept at a fault; 0: none (Recording)"
    )
    ring_mb: _Megabytes = Field(default=1000.0, description="most of the ring")
    kept_mb: _Megabytes = Field(
        default=4000.0, description="most of the recordings kept at faults; the oldest is deleted first"
    )
    run_mb: _Megabytes = Field(default=4000.0, description="most of one run; it ends there")
    free_mb: _Megabytes = Field(
        default=1000.0, description="free space kept on the disk; nothing is recorded below"
    )
    folder: PathInFile = Field(default=ABSENT, description="where recordings lie")

    def ring_of(self, hardware: str) -> float:
        """Return how long back the ring goes for hardware of a kind (`drivers.hardware.Hardware.kind`)."""
        if self.ring_s is not None:
            return self.ring_s
        return RING_S if hardware in ("real", "mixed") else 0.0


SUFFIX = ".mcap"
MB = 1e6
_NUMBER = re.compile(r"(\d{6,})-")
_NOT_IN_NAMES = re.compile(r"[^A-Za-z0-9_.-]+")


@dataclass(frozen=True)
class Recorded:
    """One recording on the disk: a run, what was kept at a fault, or the ring."""

    name: str
    kind: RecordingKind
    files: tuple[Path, ...]
    size_bytes: int
    folder: Path  # of its files; its own for what was kept

    def as_json(self) -> RecordingListed:
        """Return it as JSON."""
        return {
            "name": self.name,
            "kind": self.kind,
            "size_mb": self.size_bytes / MB,
            "files": len(self.files),
            "names": [readable(path.name) for path in self.files],
        }


class RecordFolder:
    """The files of one daemon's recordings; used by the recorder's writing thread, read by any.

    ``clock_s``, which is never set back, dates segments. Every method raises OSError if the disk refuses.
    """

    def __init__(self, folder: Path, clock_s: Callable[[], float] = time.monotonic) -> None:
        self.path = folder
        self._clock_s = clock_s
        self._opened_s = clock_s()
        self._begun_s: dict[str, float] = {}
        self._ring, self._kept, self._runs = (folder / name for name in ("ring", "kept", "runs"))

    def prepare(self) -> None:
        """Make the folders."""
        for one in (self._ring, self._kept, self._runs):
            one.mkdir(mode=0o700, parents=True, exist_ok=True)

    def free_bytes(self) -> int:
        """Return what is free on the disk for this user."""
        disk = os.statvfs(self.path)
        return disk.f_bavail * disk.f_frsize

    def next_segment(self) -> Path:
        """Return the name of the ring's next file."""
        name = f"{_next_number(_files(self._ring)):06d}-{_stamp()}{SUFFIX}"
        self._begun_s[name] = self._clock_s()
        return self._ring / name

    def next_run(self, name: str) -> Path:
        """Return the file of a run that begins now; its name is not taken."""
        stem = f"{_stamp()}{_suffix(name)}"
        names = (stem, *(f"{stem}-{number}" for number in range(2, 1000)))
        return next(path for one in names if not (path := self._runs / f"{one}{SUFFIX}").exists())

    def trim_ring(self, ring_s: float, ring_mb: float) -> None:
        """Let the oldest segments go when the newest one has ended: those that another followed ``ring_s``
        ago, and what is beyond the ring's size. The newest stays. Those of an earlier daemon date from the
        beginning of this one.
        """
        segments = _files(self._ring)
        sizes = [path.stat().st_size for path in segments]
        begun_s = [self._begun_s.get(path.name, self._opened_s) for path in segments]
        too_old_s = self._clock_s() - ring_s
        while len(segments) > 1 and (sum(sizes) > ring_mb * MB or begun_s[1] < too_old_s):
            segments.pop(0).unlink(missing_ok=True)
            del sizes[0], begun_s[0]
        self._begun_s = {path.name: at_s for path, at_s in zip(segments, begun_s, strict=True)}

    def drop_oldest_segment(self) -> bool:
        """Let the ring's oldest segment go; False if there is none beside the newest."""
        segments = _files(self._ring)
        if len(segments) > 1:
            segments[0].unlink(missing_ok=True)
        return len(segments) > 1

    def keep_ring(self, reason: str, kept_mb: float) -> str:
        """Move the ring's segments to a folder of their own and return its name, empty if there are none;
        the oldest kept ones go.
        """
        if not (segments := _files(self._ring)):
            return ""
        number = _next_number(self._kept.iterdir())
        place = self._kept / f"{number:06d}-{_stamp()}{_suffix(reason)}"
        place.mkdir(mode=0o700)
        for path in segments:
            path.rename(place / path.name)
        kept = [one for one in self.all() if one.kind == "kept"]
        while len(kept) > 1 and sum(one.size_bytes for one in kept) > kept_mb * MB:
            with contextlib.suppress(OSError):
                self.delete(kept.pop(0))
        return place.name

    def delete(self, one: Recorded) -> None:
        """Delete a run, or what was kept at a fault; other files in its folder stay."""
        for path in one.files:
            path.unlink(missing_ok=True)
        if one.kind == "kept":
            with contextlib.suppress(OSError):  # something else is in it
                one.folder.rmdir()

    def all(self) -> list[Recorded]:
        """Return every recording, the oldest of each kind first."""
        found = [_recorded(path.stem, "run", [path], self._runs) for path in _files(self._runs)]
        with contextlib.suppress(FileNotFoundError):
            folders = sorted((path for path in self._kept.iterdir() if _is_folder(path)), key=_order)
            kept = [_recorded(path.name, "kept", _files(path), path) for path in folders]
            found += [one for one in kept if one.files]
        if segments := _files(self._ring):
            found.append(_recorded("ring", "ring", segments, self._ring))
        return found


def _files(folder: Path) -> list[Path]:
    """The recordings in a folder, by their numbers if they have such, else by name; plain files only."""
    try:
        found = (path for path in folder.iterdir() if path.suffix == SUFFIX and is_plain_file(path))
        return sorted(found, key=_order)
    except FileNotFoundError:
        return []


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _order(path: Path) -> tuple[int, str]:
    """Sorts by number; what has none is older than what has one."""
    number = _NUMBER.match(path.name)
    return 0 if number is None else int(number[1]), path.name


def _next_number(paths: Iterable[Path]) -> int:
    return max((_order(path)[0] for path in paths), default=0) + 1


def _recorded(name: str, kind: RecordingKind, files: Iterable[Path], folder: Path) -> Recorded:
    sizes = {}
    for path in files:
        with contextlib.suppress(FileNotFoundError):  # it went round meanwhile
            sizes[path] = path.stat().st_size
    return Recorded(readable(name), kind, tuple(sizes), sum(sizes.values()), folder)


def _stamp() -> str:
    return datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")


def _suffix(text: str) -> str:
    """A text as the end of a file's name."""
    plain = _NOT_IN_NAMES.sub("-", text).strip("-.")[:60]
    return f"-{plain}" if plain else ""
