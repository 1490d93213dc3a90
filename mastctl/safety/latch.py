"""The latched emergency stop: held in memory from the first moment, and in the state folder across restarts.

What cannot be read counts as latched: so a stop is written over the file that says that none is, which is
there from the start, and quick. The disk never holds the stop up: a thread of its own writes, after the head
was told, and tries again for as long as the disk refuses.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

from calib.errors import BadFile
from mastctl.errors import NotNow, Stopped, Unable, one_line
from mastctl.safety.state_file import StateFile
from mastctl.safety.state_folder import StateFolder
from mastctl.state.standing import Latched

log = logging.getLogger(__name__)

SCHEMA = "mastctl/latch/1"
FILE = "latch.json"
HEAD_FIRST_S = 0.1  # how long the disk waits for the head to be told, at most
AGAIN_S = 2.0
PATIENCE_S = 2.0  # of a reset for a disk that is busy
ROOM_BYTES = 8192  # for the longest reason and name, however they are written
LONGEST = 200
"""Characters of a reason or a name that are kept."""


class Estopped(Stopped):
    """An emergency stop is latched; the move was not sent."""

    def __init__(self, message: str) -> None:
        NotNow.__init__(self, "estopped", message)


class Latch:
    """The emergency stop of one daemon; safe to use from any thread.

    Parameters
    ----------
    folder
        Where it is kept.

    Attributes
    ----------
    held
        The stop that is latched, None if none is; read without a lock.
    since_s
        When it was latched in this process, seconds of CLOCK_MONOTONIC.
    """

    def __init__(self, folder: StateFolder) -> None:
        self._folder = folder
        self._file = StateFile(folder.path / FILE, SCHEMA, ROOM_BYTES)
        self._changed = threading.Condition()
        self._disk = threading.Lock()  # for who writes; a disk that hangs holds nobody else
        self.held: Latched | None = None
        self._kept: Latched | None = None  # what a restart would find latched
        self._problem = ""
        self._asked = 0
        self.since_s = time.monotonic()
        self._due_s = 0.0  # when the disk may be written to
        self._ended = False
        try:
            document = self._file.read()
            if document is not None and _latched(document):
                self.held = Latched(*(_text(document.get(key)) for key in ("name", "reason", "at")))
        except BadFile as error:
            self.held = Latched("mastctl", f"whether one was latched cannot be read: {error}", _now())
        self._kept = self.held
        self._on_disk = self.held is not None  # whether a restart may find one, this one or another
        if self.held is not None:
            log.warning("%s", self.held.sentence)
        threading.Thread(target=self._keep, name="latch", daemon=True).start()

    def hold(self, reason: str | None, name: str | None) -> Latched:
        """Latch in memory, at once; a stop that is latched already stays as it is. Returns the one held.

        The disk is written to when `head_told` is called, or a moment later.
        """
        with self._changed:
            self._asked += 1
            if self.held is None:
                self.held = Latched(_told(name, "anonymous"), _told(reason, "no reason given"), _now())
                self.since_s = time.monotonic()
                self._due_s = self.since_s + HEAD_FIRST_S
                self._changed.notify_all()
            return self.held

    def head_told(self) -> None:
        """Let the disk be written to: the head comes first."""
        with self._changed:
            self._due_s = 0.0
            self._changed.notify_all()

    def kept_within(self, timeout_s: float) -> bool:
        """Wait ``timeout_s`` seconds at most for the disk to hold what is latched; return whether it does."""
        until_s = time.monotonic() + timeout_s
        with self._changed:
            while self._kept is not self.held and not self._problem:
                left_s = until_s - time.monotonic()
                if left_s <= 0:
                    break
                self._changed.wait(left_s)
            return self.survives

    @property
    def survives(self) -> bool:
        """Whether a restart would find what is latched."""
        return self._kept is self.held and not self._folder.is_temporary

    @property
    def not_kept(self) -> str:
        """Why an emergency stop is not kept, in plain words; empty if it is, or none is latched."""
        if self.held is None or self.survives:
            return ""
        if self._folder.is_temporary:
            return self._folder.why_temporary or "this daemon keeps its state in a temporary folder"
        return self._problem or "the disk has not confirmed it yet"

    def release(self, reason: str, name: str) -> Latched:
        """Release it on the disk, then in memory; return what was latched.

        Raises
        ------
        NotNow
            ``not_estopped`` if none is latched, ``stopping`` if another stop came meanwhile.
        Unable
            ``not_saved`` if the disk goes on to say that one is: a restart would be latched again.
        """
        name, reason = _told(name, ""), _told(reason, "")
        if not self._disk.acquire(timeout=PATIENCE_S):
            words = "the disk has not taken the emergency stop yet; a reset follows it"
            raise Unable("not_saved", words, PATIENCE_S)
        try:
            held, asked = self.held, self._asked
            if held is None:
                raise NotNow("not_estopped", "no emergency stop is latched")
            with self._changed:  # before the disk changes: from here on nobody is told that it holds a stop
                self._kept = None
            if self._on_disk:
                released = {"by": name, "reason": reason, "at": _now()}
                self._write_released({"latched": False, **asdict(held), "released": released})
            with self._changed:
                self._changed.notify_all()
                if asked != self._asked:
                    raise NotNow("stopping", "another emergency stop came during the reset; it is latched")
                self.held = None
                self._problem = ""
        finally:
            self._disk.release()
        log.warning("the emergency stop (%s: %s) is released by %s: %s", held.name, held.reason, name, reason)
        return held

    def close(self) -> None:
        """End the thread, after what is to be kept was tried once more."""
        with self._changed:
            self._ended = True
            self._due_s = 0.0
            self._changed.notify_all()

    def _write_released(self, document: dict[str, Any]) -> None:
        """Say on the disk that nothing is latched. Raises Unable."""
        ways: tuple[Callable[[], None], ...] = (
            lambda: self._file.write(document),
            lambda: self._file.overwrite(document),  # a full disk still takes this, and the room stays
            self._file.remove,  # and this one that cannot be written to
        )
        refused = ""
        for way in ways:
            try:
                way()
            except BadFile as error:
                refused = refused or str(error)
            else:
                self._on_disk = False
                return
        with self._changed:  # what the disk says is not known: the thread writes it again
            self._changed.notify_all()
        words = f"the emergency stop stays latched, since its release cannot be kept: {refused}"
        raise Unable("not_saved", words)

    def _keep(self) -> None:
        """Write what is latched, in a thread of its own."""
        with self._disk:
            if self.held is None and not self._folder.is_temporary and not self._file.has_room:
                with contextlib.suppress(BadFile):  # then a stop is written anew, and tells what is wrong
                    self._file.write({"latched": False})
        while True:
            with self._changed:
                while self.held is self._kept or time.monotonic() < self._due_s:
                    if self._ended:
                        return
                    left_s = self._due_s - time.monotonic()
                    self._changed.wait(None if self.held is self._kept else max(0.0, left_s))
            with self._disk:
                held = self.held
                if held is None:
                    continue
                try:
                    self._write_held(held)
                    problem = ""
                except BadFile as error:
                    problem = str(error)
                self._tried(held, problem)

    def _write_held(self, held: Latched) -> None:
        """Have it on the disk. Raises BadFile."""
        document = {"latched": True, **asdict(held)}
        try:
            try:
                self._file.overwrite(document)
            except BadFile:  # no file with room for it, or one that cannot be written to any more
                self._file.write(document)
        except BadFile:
            self._on_disk = self._on_disk or self._says_latched()
            raise
        self._on_disk = True

    def _says_latched(self) -> bool:
        """Whether a restart would take the file for a latched stop."""
        try:
            document = self._file.read()
        except BadFile:
            return True
        return document is not None and _latched(document)

    def _tried(self, held: Latched, problem: str) -> None:
        """Note how the writing went, and say each change once."""
        if problem and problem != self._problem:
            log.error("the emergency stop would not survive a restart: %s", problem)
        with self._changed:
            if not problem:
                self._kept = held
            self._problem = problem
            self._due_s = time.monotonic() + AGAIN_S if problem else 0.0
            self._changed.notify_all()
            if problem and self._ended:
                self._kept = held  # nothing more can be done


def _latched(document: Mapping[str, Any]) -> bool:
    return document.get("latched") is not False


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def _told(text: str | None, otherwise: str) -> str:
    """One line of bounded length."""
    return one_line(text or "", LONGEST) or otherwise


def _text(value: object) -> str:
    return one_line(value, LONGEST) if isinstance(value, str) else "not told"
