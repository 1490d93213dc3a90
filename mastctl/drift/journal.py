"""Growing files of records, one JSON line each, and the one thread that waits for a daemon's files."""

from __future__ import annotations

import json
import logging
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Generic, TypeVar

from calib.errors import BadFile
from calib.files import open_plain, replace_bytes
from drivers.clock import Clock, SystemClock
from mastctl.as_json import OtherFile, append_line
from mastctl.control.machine import StandingFault

log = logging.getLogger(__name__)
Line = TypeVar("Line", bound=Mapping[str, Any])

NEWEST_BYTES = 16_000_000
"""So much of a file without a bound is read, its newest part."""
NAME = "drift_watch"
POLL_S = 2.0
SLOW_S = 5.0
CLOSE_S = 2.0


class Journal(Generic[Line]):
    """A file of records; several processes may append to one that has no bound.

    ``plural`` names the records; ``checked`` returns a record, or raises ValueError, TypeError or LookupError
    for anything else. A file that does not begin with ``begins`` is not appended to; at ``most_bytes`` it is
    written anew with the records that still count.
    """

    def __init__(
        self, path: Path, plural: str, checked: Callable[[Any], Line], begins: bytes = b"",
        most_bytes: int | None = None,
    ) -> None:  # fmt: skip
        self.path = path
        self._plural = plural
        self._checked = checked
        self._begins = begins
        self._most_bytes = most_bytes

    def read(self) -> list[Line]:
        """Return the records, oldest first; lines that are none are left out, and logged. Raises BadFile."""
        try:
            lines = _newest_lines(self.path, 2 * self._most_bytes if self._most_bytes else NEWEST_BYTES)
        except OSError as error:
            raise BadFile(self.path, "", f"cannot be read: {error.strerror or error}") from None
        records = []
        for line in lines:
            try:
                records.append(self._checked(json.loads(line)))
            except (ValueError, TypeError, LookupError, OverflowError, RecursionError):
                continue
        if left_out := len(lines) - len(records):
            log.warning("%s: %d of %d lines are no %s", self.path, left_out, len(lines), self._plural)
        return records

    def append(self, record: Line, counting: Sequence[Line] = ()) -> None:
        """Add a record; it is on the disk, whole, when this returns.

        What a crash has left of a line at the end of the file is taken away first. At its bound the file is
        written anew with ``counting``, which has the record too. Raises BadFile, ValueError for a number that
        is not finite.
        """
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            if not append_line(self.path, _line(record), self._most_bytes, self._begins):
                replace_bytes(self.path, b"".join(map(_line, counting)))
        except OtherFile:
            message = f"holds no {self._plural}; a new or another file is expected"
            raise BadFile(self.path, "", message) from None
        except OSError as error:
            raise BadFile(self.path, "", f"cannot be written: {error.strerror or error}") from None


def _line(record: Mapping[str, Any]) -> bytes:
    return (json.dumps(record, allow_nan=False) + "\n").encode()


def _newest_lines(path: Path, most_bytes: int) -> list[bytes]:
    """Return a file's lines, of the newest so many bytes; none without a file."""
    try:
        with open_plain(path) as file:
            start = max(0, os.fstat(file.fileno()).st_size - most_bytes)
            file.seek(start)
            return file.read(most_bytes).splitlines()[1 if start else 0 :]
    except FileNotFoundError:
        return []


class JournalThread:
    """Does what may have to wait for a file, one after the other.

    ``clock`` dates the fault; ``file_time``, the machine's own clock, measures how long a file does not
    answer: a file is real, also beside a simulation.
    """

    def __init__(self, clock: Clock, file_time: Clock | None = None) -> None:
        self._clock = clock
        self._file_time = file_time or SystemClock()
        self._queue: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._polled: list[Callable[[], None]] = []
        self._busy_since_s: float | None = None
        self._thread = threading.Thread(target=self._work, name=NAME, daemon=True)
        self._thread.start()

    def put(self, act: Callable[[], None]) -> None:
        """Have something done."""
        self._queue.put(act)

    def poll(self, act: Callable[[], None]) -> None:
        """Have something done now and every few seconds."""
        self._queue.put(lambda: self._polled.append(act))
        self._queue.put(act)

    def faults(self) -> tuple[StandingFault, ...]:
        """Return what is wrong with the files: one does not answer."""
        since_s = self._busy_since_s
        waits_s = 0.0 if since_s is None else self._file_time.now_s() - since_s
        if waits_s <= SLOW_S:
            return ()
        message = "a file of the state folder does not answer; hand-offs, residuals and commands wait for it"
        return (StandingFault(NAME, "slow", message, self._clock.now_s() - waits_s, "the file answers"),)

    def close(self) -> None:
        """Finish what was put in; bounded."""
        self._queue.put(None)
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            log.error("a file of the state folder does not answer; the newest records are not kept")

    def _work(self) -> None:
        polled_s = time.monotonic()
        while True:
            with suppress(Empty):
                act = self._queue.get(timeout=POLL_S)
                if act is None:
                    return
                self._do(act)
            if time.monotonic() - polled_s >= POLL_S:
                polled_s = time.monotonic()
                for act in self._polled:
                    self._do(act)

    def _do(self, act: Callable[[], None]) -> None:
        self._busy_since_s = self._file_time.now_s()
        try:
            act()
        except Exception:  # an unexpected record must not end the thread
            log.exception("a file of the state folder met a defect of the program")
        self._busy_since_s = None
