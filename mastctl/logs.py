"""Logs that never delay their callers: how a record becomes a line, and a stream that a thread writes.

An unread pipe, a stopped terminal or a disk that hangs blocks a process in its next write, and with it every
thread that waits for a lock of the writer. Of this module only the writing thread is blocked. Texts that do
not fit into the queue meanwhile are dropped and counted; the count is logged when the output flows again.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import os
import select
import sys
import threading
import time
from collections.abc import Mapping
from functools import cache
from queue import SimpleQueue
from typing import Literal

log = logging.getLogger(__name__)

LogFormat = Literal["text", "json"]

TEXT = "%(levelname)s %(name)s: %(message)s"

_PRIORITIES = {logging.CRITICAL: 2, logging.ERROR: 3, logging.WARNING: 4, logging.INFO: 6, logging.DEBUG: 7}
"""Priorities of syslog(3), which journald reads from ``<N>`` before a line."""


class JsonLines(logging.Formatter):
    """One JSON object a line: ``time`` (UTC), ``level``, ``logger``, ``message``, ``traceback``.

    With ``priorities`` each line begins with its priority as journald reads it.
    """

    def __init__(self, *, priorities: bool = False) -> None:
        super().__init__()
        self._priorities = priorities

    def format(self, record: logging.LogRecord) -> str:
        """Return the record as one line."""
        seconds = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
        fields = {
            "time": f"{seconds}.{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info:
            fields["traceback"] = self.formatException(record.exc_info)
        line = json.dumps(fields)
        return f"<{_PRIORITIES.get(record.levelno, 6)}>{line}" if self._priorities else line


def to_journal(descriptor: int, environ: Mapping[str, str] = os.environ) -> bool:
    """Return whether a descriptor leads to journald (systemd.exec(5), JOURNAL_STREAM)."""
    device, _, inode = environ.get("JOURNAL_STREAM", "").partition(":")
    try:
        about = os.fstat(descriptor)
    except OSError:
        return False
    return (device, inode) == (str(about.st_dev), str(about.st_ino))


def formatter(wanted: LogFormat | None, descriptor: int | None = None) -> logging.Formatter:
    """Return the formatter for a descriptor, stderr by default; JSON by default where that is journald."""
    journal = to_journal(sys.stderr.fileno() if descriptor is None else descriptor)
    if wanted == "json" or (wanted is None and journal):
        return JsonLines(priorities=journal)
    return logging.Formatter(TEXT)


KEPT = 1000  # texts that wait for an output that does not flow
FLUSH_S = 1.0


class QueuedText(io.TextIOBase):
    """A text stream that never waits: what is written reaches the descriptor from a thread of its own."""

    encoding = "utf-8"

    def __init__(self, descriptor: int, kept: int = KEPT) -> None:
        self._descriptor = descriptor
        self._kept = kept
        # Without a lock: a text may be written while the same thread is inside this queue, by the garbage
        # collection or a signal.
        self._queue: SimpleQueue[str | threading.Event] = SimpleQueue()
        self._dropped = 0
        threading.Thread(target=self._work, name="output", daemon=True).start()

    def writable(self) -> bool:
        return True

    def write(self, text: str) -> int:
        if self._queue.qsize() < self._kept:
            self._queue.put(text)
        else:
            self._dropped += 1
        return len(text)

    def flush(self) -> None:
        """Return at once: the thread writes as soon as it can."""

    def written(self) -> bool:
        """Wait a second at most for all that was written so far; return whether it is out."""
        out = threading.Event()
        self._queue.put(out)
        return out.wait(FLUSH_S)

    def fileno(self) -> int:
        return self._descriptor

    def isatty(self) -> bool:
        return os.isatty(self._descriptor)

    def _work(self) -> None:
        while True:
            entry = self._queue.get()
            if isinstance(entry, str):
                self._write(entry.encode("utf-8", "backslashreplace"))
            if self._dropped and self._queue.empty():
                dropped, self._dropped = self._dropped, 0
                log.warning("%d messages were dropped while an output was not read", dropped)
            if isinstance(entry, threading.Event):
                entry.set()

    def _write(self, left: bytes) -> None:
        """Write one text whole; it is lost where nothing can be written (closed, disk full)."""
        while left:
            try:
                left = left[os.write(self._descriptor, left) :]
            except BlockingIOError:  # the process that started this one shares the pipe, without waiting
                with contextlib.suppress(OSError):
                    select.select([], [self._descriptor], [])
            except OSError:
                return


@cache
def queued(descriptor: int) -> QueuedText:
    """Return the one stream to a descriptor, which keeps the texts of several callers in order."""
    return QueuedText(descriptor)


class QueuedHandler(logging.Handler):
    """Log records by a `QueuedText`."""

    def __init__(self, stream: QueuedText) -> None:
        super().__init__()
        self._stream = stream

    def emit(self, record: logging.LogRecord) -> None:
        try:
            self._stream.write(self.format(record) + "\n")
        except Exception:  # of a message that cannot be formatted
            self.handleError(record)

    def flush(self) -> None:
        """Wait for the records of before, a second at most."""
        self._stream.written()
