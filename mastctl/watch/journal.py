"""Growing files of records, one JSON line each, and the one thread that reads and writes them."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Generic, TypeVar

from calib.errors import BadFile
from calib.files import replace_bytes
from drivers.clock import Clock, SystemClock
from mastctl.control.machine import StandingFault
from mastctl.json_lines import OtherFile, append_line, read_lines

log = logging.getLogger(__name__)
T = TypeVar("T")

MOST_WAITING = 2000
NEWEST_BYTES = 16_000_000
"""So much of a file without a bound is read, its newest part."""
NAME = "drift_watch"
POLL_S = 2.0
SLOW_S = 5.0
CLOSE_S = 2.0


class Journal(Generic[T]):
    """A file of records; several processes may append to one that has no bound.

    ``what`` names the records in the plural; ``from_json`` raises ValueError, TypeError, LookupError or
    BadFile for what is no record. A file that does not begin with ``begins`` is not appended to; at
    ``most_bytes`` it is written anew with the records that still count. ``unwritten`` says why records wait.
    """

    def __init__(
        self, path: Path, what: str, to_json: Callable[[T], Mapping[str, Any]],
        from_json: Callable[[Any], T], begins: bytes = b"", most_bytes: int | None = None,
    ) -> None:  # fmt: skip
        self.path = path
        self._what = what
        self._to_json, self._from_json = to_json, from_json
        self._begins = begins
        self._most_bytes = most_bytes
        self._waiting: deque[T] = deque(maxlen=MOST_WAITING)
        self.unwritten = ""

    def read(self) -> list[T]:
        """Return the records, oldest first; lines that are none are left out, and logged. Raises BadFile."""
        try:
            lines = read_lines(self.path, 2 * self._most_bytes if self._most_bytes else NEWEST_BYTES)
        except OSError as error:
            raise BadFile(self.path, "", f"cannot be read: {error.strerror or error}") from None
        records = []
        for line in lines:
            try:
                records.append(self._from_json(json.loads(line)))
            except (ValueError, TypeError, LookupError, OverflowError, RecursionError, BadFile):
                continue
        if len(records) < len(lines):
            left_out = len(lines) - len(records)
            log.warning("%s: %d of %d lines are no %s", self.path, left_out, len(lines), self._what)
        return records

    def earlier(self) -> list[T]:
        """Return the records, oldest first; none, and a line in the log, if the file cannot be read."""
        try:
            return self.read()
        except BadFile as error:
            log.error("%s; earlier %s do not count", _on_one_line(error), self._what)
            return []

    def append(self, record: T, counting: Sequence[T] = ()) -> bool:
        """Add a record; it is on the disk, whole, when this returns.

        What a crash has left of a line at the end of the file is taken away first. At its bound the file is
        written anew with ``counting``, which has the record too; returns whether it was. Raises BadFile,
        ValueError for a number that is not finite.
        """
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            appended = append_line(self.path, self._line(record), self._most_bytes, self._begins)
            if not appended:
                replace_bytes(self.path, b"".join(map(self._line, counting)))
            return not appended
        except OtherFile:
            message = f"holds no {self._what}; a new or another file is expected"
            raise BadFile(self.path, "", message) from None
        except OSError as error:
            raise BadFile(self.path, "", f"cannot be written: {error.strerror or error}") from None

    def keep(self, record: T, counting: Sequence[T] = ()) -> None:
        """Append a record and those that wait, oldest first; what cannot be written yet waits."""
        self._waiting.append(record)
        before, reason = self.unwritten, ""
        try:
            while self._waiting:
                try:
                    if self.append(self._waiting[0], counting):
                        self._waiting.clear()
                        break
                except ValueError as error:
                    log.error("%s: a record cannot be kept: %s", self.path, error)
                self._waiting.popleft()
        except BadFile as error:
            reason = f"{_on_one_line(error)}; {self._what} count, and wait to be written"
        self.unwritten = reason
        if reason and not before:
            log.error("%s", reason)

    def _line(self, record: T) -> bytes:
        return (json.dumps(self._to_json(record), allow_nan=False) + "\n").encode()


def _on_one_line(error: BadFile) -> str:
    return " ".join(str(error).split())


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
        self._busy_since_s: tuple[float, float] | None = None
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
        busy = self._busy_since_s
        if busy is None or self._file_time.now_s() - busy[1] <= SLOW_S:
            return ()
        message = "a file of the state folder does not answer; hand-offs, residuals and commands wait for it"
        return (StandingFault(NAME, "slow", message, busy[0], "the file answers"),)

    def close(self) -> None:
        """Finish what was put in; bounded."""
        self._queue.put(None)
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            log.error("a file of the state folder does not answer; the newest records are not kept")

    def _work(self) -> None:
        polled_s = time.monotonic()
        while True:
            acts: list[Callable[[], None]] = []
            try:
                act = self._queue.get(timeout=POLL_S)
                if act is None:
                    return
                acts.append(act)
            except Empty:
                pass
            if time.monotonic() - polled_s >= POLL_S:
                polled_s = time.monotonic()
                acts += self._polled
            for act in acts:
                self._busy_since_s = self._clock.now_s(), self._file_time.now_s()
                try:
                    act()
                except Exception:  # an unexpected record must not end the watch
                    log.exception("the drift watch met a defect of the program")
                self._busy_since_s = None
