"""The record of commands: JSON lines in a file that is bounded, written by a thread of its own.

Whoever says something is never held: not by the disk, not by a lock. What does not fit into the queue, and
what the disk does not take, is counted, and the count stands in the record where the lines are missing.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import threading
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from drivers.clock import Clock, SystemClock
from mastctl.as_json import writable
from mastctl.control.standing import StandingFault
from mastctl.errors import one_line
from mastctl.json_lines import mend

log = logging.getLogger(__name__)

DEVICE = "audit_log"
WAITING = 1000  # lines that wait for the disk
FILE_BYTES = 4 << 20
FILES = 8  # 32 MiB: some 100,000 commands
STRANGERS = "strangers_log"
STRANGERS_FILES = 2
LONGEST_LINE_BYTES = 16384
SYNC_S = 1.0  # what a power cut may take


class AuditLog:
    """A file of JSON lines, and those before it, ``NAME.1`` to ``NAME.7``; never blocks, never raises.

    Parameters
    ----------
    path
        The file, made with mode 0600; None to keep nothing.
    clock
        Stamps the fault.
    file_bytes, files
        When a new file begins, and how many are kept with it.
    device
        Under what name its fault is told.
    """

    def __init__(
        self,
        path: Path | None,
        clock: Clock | None = None,
        file_bytes: int = FILE_BYTES,
        files: int = FILES,
        device: str = DEVICE,
    ) -> None:
        self._path = path
        self._device = device
        self._clock = clock or SystemClock()
        self._file_bytes = file_bytes
        self._files = files
        self._queue: SimpleQueue[Mapping[str, Any] | threading.Event | None] = SimpleQueue()
        self._lost = 0
        # Reentrant, because a signal's handler may ask for something in the middle of it.
        self._counting = threading.RLock()
        self._fault: StandingFault | None = None
        self._descriptor = -1
        self._good_bytes = 0
        self._unsynced = False
        self._closed = False
        if path is not None:
            self._thread = threading.Thread(target=self._work, name="audit log", daemon=True)
            self._thread.start()

    def put(self, record: Mapping[str, Any]) -> None:
        """Have a record written; returns at once."""
        if self._path is None or self._closed:
            return
        if self._queue.qsize() >= WAITING:
            self._count_lost(1)
            return
        self._queue.put(record)

    def faults(self) -> tuple[StandingFault, ...]:
        """Return what is wrong with the file now; takes no lock."""
        fault = self._fault
        return () if fault is None else (fault,)

    def flush(self, timeout_s: float = 1.0) -> bool:
        """Wait until what was put before is written or lost; return whether it is, within the time."""
        if self._path is None:
            return True
        written = threading.Event()
        self._queue.put(written)
        return written.wait(timeout_s)

    def close(self, timeout_s: float = 1.0) -> None:
        """Write what waits and end, in ``timeout_s`` seconds at most."""
        if self._path is None or self._closed:
            return
        self._closed = True
        self._queue.put(None)
        self._thread.join(timeout_s)

    # In the writing thread

    def _work(self) -> None:
        while True:
            try:
                entry = self._queue.get(timeout=SYNC_S if self._unsynced else None)
            except Empty:
                self._sync()
                continue
            if isinstance(entry, threading.Event):
                entry.set()
            elif entry is None:
                self._sync()
                self._close_file()
                return
            else:
                self._write(entry)

    def _write(self, record: Mapping[str, Any]) -> None:
        lost = self._lost
        try:
            line = _line(record)
            if lost:
                line = _line({"time": datetime.now(UTC).isoformat(), "lost": lost}) + line
            self._append(line)
        except Exception as error:  # the disk's, or of a record that cannot be written; the next one may be
            self._count_lost(1)
            self._close_file()
            self._fail(error)
            return
        if lost:
            self._count_lost(-lost)
            log.warning("the audit log is written again; %d lines are missing in it", lost)
        self._fault = None

    def _count_lost(self, lines: int) -> None:
        with self._counting:
            self._lost += lines

    def _append(self, line: bytes) -> None:
        """Write some lines whole, or leave the file as it was."""
        if self._descriptor < 0:
            self._open()
        if self._good_bytes and self._good_bytes + len(line) > self._file_bytes:
            with contextlib.suppress(OSError):  # then the present file goes on
                self._rotate()
        try:
            written = 0
            while written < len(line):
                written += os.write(self._descriptor, line[written:])
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, self._good_bytes)
            raise
        self._good_bytes += len(line)
        self._unsynced = True

    def _open(self) -> None:
        """Open the file, without what a crash has left of a line at its end."""
        assert self._path is not None
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._descriptor = _opened(self._path)
        self._good_bytes = mend(self._descriptor)

    def _rotate(self) -> None:
        """Begin a new file; the one that was is ``NAME.1``, and the oldest goes."""
        assert self._path is not None
        path, following = self._path, self._path.with_name(self._path.name + ".next")
        descriptor = _opened(following)  # first, so that without one the present file goes on
        for number in range(self._files - 1, 0, -1):
            older = path if number == 1 else path.with_name(f"{path.name}.{number - 1}")
            with contextlib.suppress(FileNotFoundError):
                older.replace(path.with_name(f"{path.name}.{number}"))
        following.replace(path)
        self._sync()
        os.close(self._descriptor)
        self._descriptor, self._good_bytes = descriptor, os.fstat(descriptor).st_size

    def _sync(self) -> None:
        self._unsynced = False
        if self._descriptor >= 0:
            with contextlib.suppress(OSError):
                os.fdatasync(self._descriptor)

    def _close_file(self) -> None:
        if self._descriptor >= 0:
            with contextlib.suppress(OSError):
                os.close(self._descriptor)
        self._descriptor = -1

    def _fail(self, error: Exception) -> None:
        why = error.strerror if isinstance(error, OSError) else None
        words = f"commands are not recorded: {self._path}: {why or one_line(error, 200)}"
        if self._fault is None:
            log.error("%s", words)
            until = "a command can be recorded again"
            self._fault = StandingFault(self._device, "not_recorded", words, self._clock.now_s(), until)


def _opened(path: Path) -> int:
    return os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600)


def _line(record: Mapping[str, Any]) -> bytes:
    """A record as a line; a request that is too long for one is cut, and says so."""
    line = _json(record)
    if len(line) >= LONGEST_LINE_BYTES and "request" in record:
        beginning = _json(record["request"]).decode()[: LONGEST_LINE_BYTES // 16]
        line = _json({**record, "request": {"cut": beginning}})
    return line[: LONGEST_LINE_BYTES - 1] + b"\n"


def _json(value: Any) -> bytes:
    return json.dumps(writable(value), allow_nan=False, separators=(",", ":")).encode()
