"""The latch of a head: in memory from the first moment, and on the disk across restarts.

It is kept in the head's folder (`mastctl.safety.state_folder`), or in the state folder for a head in this
program's memory. It keeps a log of its causes, and a reset releases all of them.

A file that cannot be read means latched: so a stop is written over the file of a released latch, which exists
from the start, and quick. The stop never waits for the disk: a thread of its own writes, after the head was
stopped, and tries again for as long as the disk refuses.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
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
USED_SCHEMA = "mastctl/latch-used/1"
USED = "latch.used.json"
"""Names a place where a latch file was: where it is gone, its content is unknown."""
NO_NAME, NO_REASON = "anonymous", "no reason given"
MOST = 5  # causes: strangers with many names fill no disk
HEAD_FIRST_S = 0.1  # how long the disk waits for the head's stop, at most
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

    ``folder``: where the causes are kept; ``state``: the daemon's state folder, if that is another one; it
    remembers where the latch is; ``others``: folders beside them: what is latched there counts too, and is
    released there too.

    ``entries``: the causes, the oldest first, empty if nothing is latched; read without a lock; ``since_s``:
    when the first one was latched in this process, seconds of CLOCK_MONOTONIC.
    """

    def __init__(
        self, folder: StateFolder, state: StateFolder | None = None, others: Sequence[Path] = ()
    ) -> None:
        self.folder = folder
        self._file = _file_in(folder.path)
        places = [folder.path] if state is None else [folder.path, state.path]
        self._marks = _marks_in(places)
        self._others = [_file_in(other) for other in (*others, *places[1:])]
        self._changed = threading.Condition()
        self._disk = threading.Lock()  # for writers; a disk that hangs holds no other thread
        self.entries: tuple[Latched, ...] = ()
        self._kept: tuple[Latched, ...] | None = ()  # what a restart would find latched
        self._problem = ""
        self._count = 0  # of requests
        self.since_s = time.monotonic()
        self._due_s = 0.0  # when the disk may be written to
        self._ended = False
        found = _entries(self._file)
        self.entries = _gone(self._file, self._marks) if found is None else found
        self.entries = _merged(self.entries, *(_entries(other) or () for other in self._others))
        self._kept = self.entries if self.entries == (found or ()) else found
        self._on_disk = bool(self.entries)  # whether a restart may find one, this one or another
        if self.entries:
            log.warning("%s", latched_sentence(self.entries))
        threading.Thread(target=self._keep, name="latch", daemon=True).start()

    def add(self, reason: str | None, name: str | None) -> Latched:
        """Latch in memory, at once; return the cause. The log keeps each once, and the first `MOST`.

        The disk is written to when `head_stopped` is called, or a moment later.
        """
        with self._changed:
            self._count += 1
            cause = Latched(_line(name, NO_NAME), _line(reason, NO_REASON), _now())
            before = self.entries
            self.entries = _merged(before, (cause,))
            if self.entries is not before:
                now_s = time.monotonic()
                self.since_s = self.since_s if before else now_s
                self._due_s = now_s + HEAD_FIRST_S
                self._changed.notify_all()
            return next((one for one in self.entries if _same(one, cause)), cause)

    def explain(self, reason: str | None, name: str | None) -> Latched | None:
        """Give the cause without name and reason those that came after its stop; return it.

        None if there is no such cause.
        """
        with self._changed:
            bare = next((one for one in self.entries if (one.name, one.reason) == (NO_NAME, NO_REASON)), None)
            if bare is None:
                return None
            self._count += 1  # a reset that is under way has not released this
            cause = replace(bare, name=_line(name, NO_NAME), reason=_line(reason, NO_REASON))
            self.entries = _merged((), tuple(cause if one is bare else one for one in self.entries))
            self._changed.notify_all()
            return cause

    def head_stopped(self) -> None:
        """Let the disk be written to: the head comes first."""
        with self._changed:
            self._due_s = 0.0
            self._changed.notify_all()

    def kept_within(self, timeout_s: float) -> bool:
        """Wait ``timeout_s`` seconds at most for the disk to hold what is latched; return whether it does."""
        until_s = time.monotonic() + timeout_s
        with self._changed:
            while self._kept is not self.entries and not self._problem:
                left_s = until_s - time.monotonic()
                if left_s <= 0:
                    break
                self._changed.wait(left_s)
            return self.survives

    @property
    def survives(self) -> bool:
        """Whether a restart would find what is latched."""
        return self._kept is self.entries and not self.folder.is_temporary

    @property
    def not_kept(self) -> str:
        """Why an emergency stop is not kept, one sentence; empty if it is, or none is latched."""
        if not self.entries or self.survives:
            return ""
        if self.folder.is_temporary:
            return self.folder.why_temporary or "this daemon keeps its state in a temporary folder"
        return self._problem or "the disk has not confirmed it yet"

    def release(self, reason: str, name: str) -> tuple[Latched, ...]:
        """Release the latch on the disk, then in memory; return its causes.

        Raises NotNow ``not_estopped`` if none is latched, ``stopping`` if another stop came meanwhile; Unable
        ``not_saved`` if the disk still has the stop: a restart would be latched again.
        """
        name, reason = _line(name, ""), _line(reason, "")
        if not self._disk.acquire(timeout=PATIENCE_S):
            message = "the disk has not taken the emergency stop yet; a reset follows it"
            raise Unable("not_saved", message, PATIENCE_S)
        try:
            causes, count = self.entries, self._count
            if not causes:
                raise NotNow("not_estopped", "no emergency stop is latched")
            with self._changed:  # before the disk changes: from here on no answer states that it has the stop
                self._kept = None
            if self._on_disk:
                released = {"by": name, "reason": reason, "at": _now()}
                self._write_released({"latched": False, **asdict(causes[0]), "released": released})
            with self._changed:
                self._changed.notify_all()
                if count != self._count:
                    raise NotNow("stopping", "another emergency stop came during the reset; it is latched")
                self.entries = self._kept = ()
                self._problem = ""
        finally:
            self._disk.release()
        listed = "; ".join(f"{one.name}: {one.reason}" for one in causes)
        log.warning("the emergency stop (%s) is released by %s: %s", listed, name, reason)
        return causes

    def close(self) -> None:
        """End the thread, after what is to be kept was tried once more."""
        with self._changed:
            self._ended = True
            self._due_s = 0.0
            self._changed.notify_all()

    def _write_released(self, document: dict[str, Any]) -> None:
        """Write to the disk that nothing is latched. Raises Unable."""

        def remove() -> None:
            for file in (*self._marks, self._file):  # without its mark the file is not missed
                file.remove()

        ways: tuple[Callable[[], None], ...] = (
            lambda: self._file.write(document),
            lambda: self._file.overwrite(document),  # a full disk still takes this, and the room stays
            remove,  # and this one that cannot be written to
        )
        refused = ""
        for file in self._others:
            try:
                if _entries(file):
                    file.write(document)
            except BadFile as error:
                refused = str(error)
        for way in () if refused else ways:
            try:
                way()
            except BadFile as error:
                refused = refused or str(error)
            else:
                self._on_disk = False
                return
        with self._changed:  # what the disk says is not known: the thread writes it again
            self._changed.notify_all()
        message = f"the emergency stop stays latched, since its release cannot be kept: {refused}"
        raise Unable("not_saved", message)

    def _keep(self) -> None:
        """Write what is latched, in a thread of its own."""
        with self._disk:
            if not self.entries and not self.folder.is_temporary and not self._file.has_room:
                with contextlib.suppress(BadFile):  # then a stop is written anew, and reports the fault
                    self._file.write({"latched": False})
            self._mark()
        while True:
            with self._changed:
                while self.entries is self._kept or time.monotonic() < self._due_s:
                    if self._ended:
                        return
                    left_s = self._due_s - time.monotonic()
                    self._changed.wait(None if self.entries is self._kept else max(0.0, left_s))
            with self._disk:
                entries = self.entries
                if not entries:
                    continue
                try:
                    self._write(entries)
                    self._mark()
                    problem = ""
                except BadFile as error:
                    problem = str(error)
                self._tried(entries, problem)

    def _mark(self) -> None:
        """Remember that the file is there, once it is."""
        if self.folder.is_temporary or not self._file.path.exists():
            return
        for mark in self._marks:
            with contextlib.suppress(BadFile):
                if not _names(mark, self._file):
                    mark.write({"latch": str(self._file.path)})

    def _write(self, entries: tuple[Latched, ...]) -> None:
        """Have causes on the disk. Raises BadFile."""
        document = _document(entries)
        try:
            try:
                self._file.overwrite(document)
            except BadFile:  # no file with room for it, or one that cannot be written to any more
                self._file.write(document)
        except BadFile:
            self._on_disk = self._on_disk or bool(_entries(self._file))
            raise
        self._on_disk = True

    def _tried(self, entries: tuple[Latched, ...], problem: str) -> None:
        """Note how the writing went, and log each change once."""
        if problem and problem != self._problem:
            log.error("the emergency stop would not survive a restart: %s", problem)
        with self._changed:
            if not problem:
                self._kept = entries
            self._problem = problem
            self._due_s = time.monotonic() + AGAIN_S if problem else 0.0
            self._changed.notify_all()
            if problem and self._ended:
                self._kept = entries  # nothing more can be done


def latched_at(folders: Sequence[Path], others: Sequence[Path]) -> tuple[Latched, ...]:
    """Return the causes of a head's latch, for a program that only reads.

    ``folders`` are its place and the state folder, as far as they are known; ``others`` as of `Latch`.
    """
    entries: tuple[Latched, ...] = ()
    if folders:
        file = _file_in(folders[0])
        found = _entries(file)
        entries = _gone(file, _marks_in(folders)) if found is None else found
    return _merged(entries, *(_entries(_file_in(other)) or () for other in (*others, *folders[1:])))


def _marks_in(folders: Sequence[Path]) -> list[StateFile]:
    return [StateFile(folder / USED, USED_SCHEMA) for folder in folders]


def _file_in(folder: Path) -> StateFile:
    return StateFile(folder / FILE, SCHEMA, ROOM_BYTES, 0o644)


def _names(mark: StateFile, file: StateFile) -> bool:
    """Whether a mark names a latch file; one that cannot be read is treated so too."""
    try:
        content = mark.read()
    except BadFile:
        return True
    return content is not None and content.get("latch") == str(file.path)


def _gone(file: StateFile, marks: Sequence[StateFile]) -> tuple[Latched, ...]:
    """What is latched where there is no latch file: nothing, unless there was one."""
    if not any(_names(mark, file) for mark in marks):
        return ()
    reason = f"whether one was latched is not known, since {file.path} is gone"
    return (Latched("mastctl", one_line(reason, LONGEST), _now()),)


def _entries(file: StateFile) -> tuple[Latched, ...] | None:
    """The causes in a latch file, None without a file; one that cannot be read means latched."""
    try:
        document = file.read()
    except BadFile as error:
        return (Latched("mastctl", f"whether one was latched cannot be read: {error}", _now()),)
    if document is None:
        return None
    if document.get("latched") is False:
        return ()
    more = document.get("more")
    parts = [document, *(more if isinstance(more, list) else ())]
    found = (
        Latched(*(_text(one.get(key)) for key in ("name", "reason", "at")))
        for one in parts[:MOST]
        if isinstance(one, Mapping)
    )
    return _merged((), tuple(found))


def _document(entries: tuple[Latched, ...]) -> dict[str, Any]:
    """As a file has them: the oldest at the top, as one alone always was."""
    first, *more = entries
    return {"latched": True, **asdict(first)} | ({"more": [asdict(one) for one in more]} if more else {})


def _merged(entries: tuple[Latched, ...], *more: tuple[Latched, ...]) -> tuple[Latched, ...]:
    """Causes with further ones, `MOST` at most; the same tuple if there are none."""
    for one in itertools.chain(*more):
        if len(entries) < MOST and not any(_same(one, other) for other in entries):
            entries = (*entries, one)
    return entries


def _same(one: Latched, other: Latched) -> bool:
    return (one.name, one.reason) == (other.name, other.reason)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def _line(text: str | None, otherwise: str) -> str:
    """One line of bounded length."""
    return one_line(text or "", LONGEST) or otherwise


def _text(value: object) -> str:
    return one_line(value, LONGEST) if isinstance(value, str) else "not stated"
