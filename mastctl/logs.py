"""Logs that never delay their callers: how a record becomes a line, and a thread that writes it.

An unread pipe, a stopped terminal or a disk that hangs blocks a process in its next write, and with it every
thread that waits for a lock of the writer. Of this module only the writing thread is blocked. Messages that
do not fit into the queue meanwhile are dropped and counted; the count is logged when the output flows again.
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
from collections import deque
from collections.abc import Callable, Mapping
from functools import cache
from queue import SimpleQueue
from typing import Literal

LogFormat = Literal["text", "json"]

TEXT = "%(levelname)s %(name)s: %(message)s"

_PRIORITIES = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
"""Priorities of syslog(3), which journald reads from ``<N>`` before a line; lower levels are 7."""


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
        return f"<{_priority(record.levelno)}>{line}" if self._priorities else line


def _priority(level: int) -> int:
    return next((priority for least, priority in _PRIORITIES if level >= least), 7)


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


KEPT = 1000  # messages that wait for an output that does not flow
FLUSH_S = 1.0

STALLED_S = 0.05

Message = str | Callable[[], str]

_stalls: list[Callable[[], bool]] = []


def stall_while(stalled: Callable[[], bool]) -> None:
    """Have outputs of this process behave as if unread, while the function given last returns true."""
    _stalls[:] = [stalled]


class QueuedWriter:
    """Writes text to a file descriptor, in the order given, from a thread of its own; ``kept`` may wait.

    ``own_line`` makes a line of a message of the writer itself.
    """

    def __init__(self, descriptor: int, kept: int = KEPT) -> None:
        self.descriptor = descriptor
        self._kept = kept
        self._queue: SimpleQueue[Message | threading.Event] = SimpleQueue()
        self._dropped = deque[None]()  # one for each dropped message
        self.own_line: Callable[[str], str] = lambda message: f"mastctl: {message}\n"
        threading.Thread(target=self._work, name="output", daemon=True).start()

    def put(self, message: Message) -> None:
        """Have a text written, or a function's result, made in the writing thread; returns at once."""
        if self._queue.qsize() >= self._kept:
            self._dropped.append(None)
            return
        if self._dropped:
            self._queue.put(self._dropped_line)
        self._queue.put(message)

    def flush(self, timeout_s: float = FLUSH_S) -> bool:
        """Wait until all of before is written, ``timeout_s`` seconds at most; return whether it is."""
        written = threading.Event()
        self._queue.put(written)
        return written.wait(timeout_s)

    def _dropped_line(self) -> str:
        dropped = 0
        with contextlib.suppress(IndexError):
            while True:
                self._dropped.popleft()
                dropped += 1
        if not dropped:
            return ""
        return self.own_line(f"{dropped} messages were dropped here while this output was not read")

    # In the writing thread

    def _work(self) -> None:
        while True:
            entry = self._queue.get()
            if not isinstance(entry, threading.Event):
                self._write(entry)
            if self._dropped and self._queue.empty():
                self._write(self._dropped_line)
            if isinstance(entry, threading.Event):
                entry.set()

    def _write(self, message: Message) -> None:
        """Write one message whole; it is lost where nothing can be written (closed, disk full)."""
        try:
            text = message if isinstance(message, str) else message()
        except Exception as error:  # of its formatting, which must not end the thread
            text = self.own_line(f"a message could not be put into words: {type(error).__name__}")
        left = text.encode("utf-8", "backslashreplace")
        while left:
            while any(stalled() for stalled in _stalls):
                time.sleep(STALLED_S)
            try:
                left = left[os.write(self.descriptor, left) :]
            except BlockingIOError:  # the process that started this one shares the pipe, without waiting
                with contextlib.suppress(OSError):
                    select.select([], [self.descriptor], [])
            except OSError:
                return


@cache
def writer_to(descriptor: int) -> QueuedWriter:
    """Return the one writer to a descriptor, which keeps the messages of several callers in order."""
    return QueuedWriter(descriptor)


class QueuedText(io.TextIOBase):
    """A text stream on a `QueuedWriter`, in the place of ``sys.stderr`` or ``sys.stdout``; never waits."""

    encoding = "utf-8"

    def __init__(self, writer: QueuedWriter) -> None:
        self._writer = writer

    def writable(self) -> bool:
        return True

    def write(self, text: str) -> int:
        if text:
            self._writer.put(text)
        return len(text)

    def flush(self) -> None:
        """Return at once: the thread writes as soon as it can."""

    def fileno(self) -> int:
        return self._writer.descriptor

    def isatty(self) -> bool:
        return os.isatty(self._writer.descriptor)


class QueuedHandler(logging.Handler):
    """Log records through a `QueuedWriter`: no lock, and formatted in the writing thread."""

    def __init__(self, writer: QueuedWriter) -> None:
        super().__init__()
        self._writer = writer

    def setFormatter(self, fmt: logging.Formatter | None) -> None:
        """Format records, and messages of the writer itself, by this."""
        super().setFormatter(fmt)
        if fmt is not None:
            about = {"name": "mastctl", "levelno": logging.WARNING, "levelname": "WARNING"}
            self._writer.own_line = lambda message: (
                fmt.format(logging.makeLogRecord({**about, "msg": "%s", "args": (message,)})) + "\n"
            )

    def createLock(self) -> None:
        self.lock = None

    def handle(self, record: logging.LogRecord) -> bool:
        """Emit a record that the filters pass; the library's own method takes the lock."""
        passed = self.filter(record)
        if passed:
            self.emit(passed if isinstance(passed, logging.LogRecord) else record)
        return bool(passed)

    def emit(self, record: logging.LogRecord) -> None:
        self._writer.put(lambda: self.format(record) + "\n")

    def flush(self) -> None:
        """Wait for the records of before, a second at most."""
        self._writer.flush()
