"""The latch of a head: in memory from the first moment, and on the disk across restarts.

It lies in the head's folder (`mastctl.safety.state_folder`), or in the state folder for a head in this
program's memory. It has a log of its causes, and a reset releases all of them.

A file that cannot be read means latched, so a stop is written over the file of a released latch, which exists
from the start, and quickly. The stop never waits for the disk: a thread writes, after the head was stopped,
and tries again for as long as the disk refuses.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from calib.errors import BadFile
from mastctl.control.machine import Latched, latched_sentence
from mastctl.errors import NotNow, Stopped, Unable, one_line
from mastctl.safety.state_folder import StateFile, StateFolder

log = logging.getLogger(__name__)

SCHEMA = "mastctl/latch/1"
FILE = "latch.json"
BARE = "anonymous", "no reason given"  # name and reason of a stop that came without
MOST = 5  # causes: strangers with many names fill no disk
AGAIN_S = 2.0
PATIENCE_S = 2.0  # of a reset for a disk that is busy
ROOM_BYTES = 32768  # for the longest reasons and names of all entries, however they are written
LONGEST = 200  # characters of a reason or a name that are kept


class Estopped(Stopped):
    """An emergency stop is latched; the move was not sent."""

    def __init__(self, message: str) -> None:
        NotNow.__init__(self, "estopped", message)


class Latch:
    """The emergency stop of one head; safe to use from any thread.

    ``folder`` is where the causes are written; what is latched in the folders ``others`` counts too, and is
    released there too.

    ``entries``: the causes, the oldest first, empty if nothing is latched; read without a lock. ``since_s``:
    when the first one was latched in this process, seconds of CLOCK_MONOTONIC.
    """

    def __init__(self, folder: StateFolder, others: Sequence[Path] = ()) -> None:
        self.folder = folder
        self._file = _file_in(folder.path)
        self._others = [_file_in(other) for other in others if other != folder.path]
        self.entries = latched_at([folder.path, *(other.path.parent for other in self._others)])
        self.since_s = time.monotonic()
        self._on_disk: tuple[Latched, ...] | None = self.entries  # what a restart would find, None: unknown
        self._problem = ""  # why the disk refused the last time
        self._count = 0  # of requests
        self._changed = threading.Condition()
        self._disk = threading.Lock()  # for writers; a disk that hangs blocks no other thread
        self._ended = False
        if self.entries:
            log.warning("%s", latched_sentence(self.entries))
        threading.Thread(target=self._work, name="latch", daemon=True).start()

    def add(self, reason: str | None, name: str | None) -> Latched:
        """Latch in memory, at once; return the cause. The log has each once, and the first `MOST`.

        `keep` has it written, once the head was stopped.
        """
        cause = Latched(_line(name) or BARE[0], _line(reason) or BARE[1], _now())
        with self._changed:
            self._count += 1
            if not self.entries:
                self.since_s = time.monotonic()
            self.entries = _merged((*self.entries, cause))
            given = cause.name, cause.reason
            return next((one for one in self.entries if (one.name, one.reason) == given), cause)

    def keep(self, timeout_s: float) -> bool:
        """Have the disk hold what is latched; return whether it does within ``timeout_s`` seconds."""
        with self._changed:
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._on_disk == self.entries or self._problem, timeout_s)
        return not self.not_kept

    @property
    def not_kept(self) -> str:
        """Why a restart would not find what is latched, one sentence; empty if it would, or nothing is."""
        if not self.entries:
            return ""
        if self.folder.is_temporary:
            return "this daemon keeps its state in a temporary folder"
        return "" if self._on_disk == self.entries else self._problem or "the disk has not confirmed it yet"

    def release(self, reason: str, name: str) -> tuple[Latched, ...]:
        """Release the latch on the disk, then in memory; return its causes.

        Raises NotNow ``not_estopped`` if none is latched, ``stopping`` if another stop came meanwhile; Unable
        ``not_saved`` if the disk still has the stop: a restart would be latched again.
        """
        name, reason = _line(name), _line(reason)
        if not self._disk.acquire(timeout=PATIENCE_S):
            message = "the disk has not taken the emergency stop yet; a reset follows it"
            raise Unable("not_saved", message, PATIENCE_S)
        try:
            causes, count = self.entries, self._count
            if not causes:
                raise NotNow("not_estopped", "no emergency stop is latched")
            self._on_disk = None  # from here on no answer states that the disk has the stop
            released = {"by": name, "reason": reason, "at": _now()}
            document = {"latched": False, **asdict(causes[0]), "released": released}
            for file in (*self._others, self._file):
                if _entries(file):
                    file.overwrite(document)
            with self._changed:
                if count != self._count:
                    raise NotNow("stopping", "another emergency stop came during the reset; it is latched")
                self.entries = self._on_disk = ()
                self._problem = ""
        except BadFile as error:
            message = f"the emergency stop stays latched, since its release cannot be kept: {error}"
            raise Unable("not_saved", message) from None
        finally:
            self._disk.release()
            self.keep(0.0)  # after a refusal the stop is written again
        listed = "; ".join(f"{one.name}: {one.reason}" for one in causes)
        log.warning("the emergency stop (%s) is released by %s: %s", listed, name, reason)
        return causes

    def close(self) -> None:
        """End the thread, after one more try for what is not on the disk."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _work(self) -> None:
        """Write what is latched, in a thread of its own."""
        with self._disk, contextlib.suppress(BadFile):  # without it a stop is written anew, and reports why
            if not self._file.path.exists():
                self._file.write({"latched": False})
        while not self._ended:
            with self._changed:
                if self._problem and not self._ended:
                    self._changed.wait(AGAIN_S)
                while not self._ended and self._on_disk == self.entries:
                    self._changed.wait()
            with self._disk:
                if self._on_disk != self.entries:
                    self._write(self.entries)

    def _write(self, entries: tuple[Latched, ...]) -> None:
        problem, (first, *more) = "", entries
        document: dict[str, Any] = {"latched": True, **asdict(first)}
        try:
            self._file.overwrite(document | ({"more": [asdict(one) for one in more]} if more else {}))
        except BadFile as error:
            problem = str(error)
        if problem and problem != self._problem:
            log.error("the emergency stop would not survive a restart: %s", problem)
        with self._changed:
            self._problem = problem
            if not problem:
                self._on_disk = entries
            self._changed.notify_all()


def latched_at(folders: Iterable[Path]) -> tuple[Latched, ...]:
    """Return the causes of a head's latch, wherever they lie."""
    return _merged(one for folder in folders for one in _entries(_file_in(folder)))


def _file_in(folder: Path) -> StateFile:
    return StateFile(folder / FILE, SCHEMA, ROOM_BYTES, 0o644)


def _entries(file: StateFile) -> Sequence[Latched]:
    """The causes in a latch file; one that cannot be read means latched."""
    try:
        document = file.read()
    except BadFile as error:
        return [Latched("mastctl", f"whether one was latched cannot be read: {error}", _now())]
    if document is None or document.get("latched") is False:
        return ()
    more = document.get("more")
    parts = [document, *(more if isinstance(more, list) else ())]
    return [
        Latched(*(_line(one.get(key)) or "not stated" for key in ("name", "reason", "at")))
        for one in parts[:MOST]
        if isinstance(one, dict)
    ]


def _merged(entries: Iterable[Latched]) -> tuple[Latched, ...]:
    """The causes, each once, `MOST` at most."""
    by_cause: dict[tuple[str, str], Latched] = {}
    for one in entries:
        by_cause.setdefault((one.name, one.reason), one)
    return tuple(by_cause.values())[:MOST]


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def _line(text: object) -> str:
    """One line of bounded length; empty for what is no text."""
    return one_line(text, LONGEST) if isinstance(text, str) else ""
