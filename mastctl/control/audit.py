"""The record of commands: JSON lines in a bounded file, written by a thread of its own.

No caller waits for the disk. Lines that do not fit into the queue, or that the disk does not take, are
counted, and their number is recorded where they are missing.
"""

from __future__ import annotations

import contextlib
import json
import logging
import threading
from collections import deque
from collections.abc import Mapping
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from queue import Queue
from typing import Any

from drivers.clock import Clock, SystemClock
from mastctl.as_json import writable
from mastctl.control.machine import StandingFault
from mastctl.errors import one_line
from mastctl.json_lines import append_line

log = logging.getLogger(__name__)

DEVICE = "audit_log"
WAITING = 1000  # lines that wait for the disk
FILE_BYTES = 4 << 20
FILES = 8  # 32 MiB: some 100,000 commands
STRANGERS = "strangers_log"
STRANGERS_FILES = 2
LONGEST_LINE = 16384


class AuditLog:
    """A file of JSON lines of mode 0600, and those before it, ``NAME.1`` to ``NAME.7``.

    It never blocks, and never raises; without a path it keeps nothing. ``device`` is the name of its fault.
    """

    def __init__(
        self,
        path: Path | None,
        clock: Clock | None = None,
        file_bytes: int = FILE_BYTES,
        files: int = FILES,
        device: str = DEVICE,
    ) -> None:
        self._device = device
        self._clock = clock or SystemClock()
        self._queue: Queue[Mapping[str, Any] | threading.Event | None] = Queue()
        self._lost = deque[None]()  # one for each lost line
        self._fault: StandingFault | None = None
        self._closed = path is None
        if path is not None:
            self._path, self._file_bytes, self._files = path, file_bytes, files
            self._thread = threading.Thread(target=self._work, name="audit log", daemon=True)
            self._thread.start()

    def put(self, record: Mapping[str, Any]) -> None:
        """Have a record written; returns at once."""
        if self._closed:
            return
        if self._queue.qsize() >= WAITING:
            self._lost.append(None)
        else:
            self._queue.put(record)

    def faults(self) -> tuple[StandingFault, ...]:
        """Return what is wrong with the file now; takes no lock."""
        fault = self._fault
        return () if fault is None else (fault,)

    def flush(self, timeout_s: float = 1.0) -> bool:
        """Wait until all lines of before are written or lost; return whether they are, within the time."""
        if self._closed:
            return True
        written = threading.Event()
        self._queue.put(written)
        return written.wait(timeout_s)

    def close(self, timeout_s: float = 1.0) -> None:
        """Write the lines that wait and end, in ``timeout_s`` seconds at most."""
        if not self._closed:
            self._closed = True
            self._queue.put(None)
            self._thread.join(timeout_s)

    # In the writing thread

    def _work(self) -> None:
        while (entry := self._queue.get()) is not None:
            if isinstance(entry, threading.Event):
                entry.set()
            else:
                self._write(entry)

    def _write(self, record: Mapping[str, Any]) -> None:
        lost = len(self._lost)
        try:
            lines = [{"time": datetime.now(UTC).isoformat(), "lost": lost}] if lost else []
            self._append("".join(f"{_line(one)}\n" for one in (*lines, record)).encode())
        except Exception as error:  # the disk's, or of a record that cannot be written; the next one may be
            self._lost.append(None)
            self._fail(error)
            return
        if lost:
            for _ in range(lost):
                self._lost.popleft()
            log.warning("the audit log is written again; %d lines are missing in it", lost)
        self._fault = None

    def _append(self, text: bytes) -> None:
        """Append lines, in a new file where this one is full."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        if not append_line(self._path, text, self._file_bytes, mode=0o600):
            names = [self._path, *(Path(f"{self._path}.{number}") for number in range(1, self._files))]
            for older, newer in reversed(list(pairwise(names))):
                with contextlib.suppress(FileNotFoundError):
                    older.replace(newer)
            append_line(self._path, text, mode=0o600)

    def _fail(self, error: Exception) -> None:
        why = error.strerror if isinstance(error, OSError) else None
        message = f"commands are not recorded: {self._path}: {why or one_line(error, 200)}"
        if self._fault is None:
            log.error("%s", message)
            until = "a command can be recorded again"
            self._fault = StandingFault(self._device, "not_recorded", message, self._clock.now_s(), until)


def _line(record: Mapping[str, Any]) -> str:
    """A record as a line; a request that is too long for one is cut, which its key shows."""
    line = _json(record)
    if len(line) > LONGEST_LINE and "request" in record:
        line = _json({**record, "request": {"cut": _json(record["request"])[: LONGEST_LINE // 16]}})
    return line[:LONGEST_LINE]


def _json(value: Any) -> str:
    return json.dumps(writable(value), allow_nan=False, separators=(",", ":"))
