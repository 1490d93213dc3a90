"""How a log record becomes a line: words for a terminal, JSON for journald and what else reads logs."""

from __future__ import annotations

import json
import logging
import os
import sys
import time
from collections.abc import Mapping
from typing import Literal

LogFormat = Literal["text", "json"]

TEXT = "%(levelname)s %(name)s: %(message)s"

_PRIORITIES = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
"""Priorities of syslog(3), which journald reads from ``<N>`` before a line; lower levels are 7."""


class JsonLines(logging.Formatter):
    """One JSON object a line: ``time`` (UTC), ``level``, ``logger``, ``message``, ``traceback``.

    Parameters
    ----------
    priorities
        Whether each line begins with its priority as journald reads it.
    """

    def __init__(self, *, priorities: bool = False) -> None:
        super().__init__()
        self._priorities = priorities

    def format(self, record: logging.LogRecord) -> str:
        """Return the record as one line."""
        seconds = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
        told = {
            "time": f"{seconds}.{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info:
            told["traceback"] = self.formatException(record.exc_info)
        line = json.dumps(told)
        return f"<{_priority(record.levelno)}>{line}" if self._priorities else line


def _priority(level: int) -> int:
    return next((priority for least, priority in _PRIORITIES if level >= least), 7)


def to_journal(descriptor: int, environ: Mapping[str, str] = os.environ) -> bool:
    """Return whether what is written to a descriptor goes to journald (systemd.exec(5), JOURNAL_STREAM)."""
    device, _, inode = environ.get("JOURNAL_STREAM", "").partition(":")
    try:
        about = os.fstat(descriptor)
    except OSError:
        return False
    return (device, inode) == (str(about.st_dev), str(about.st_ino))


def formatter(wanted: LogFormat | None, descriptor: int | None = None) -> logging.Formatter:
    """Return what makes lines for a descriptor, stderr by default; JSON unasked where it goes to journald."""
    journal = to_journal(sys.stderr.fileno() if descriptor is None else descriptor)
    if wanted == "json" or (wanted is None and journal):
        return JsonLines(priorities=journal)
    return logging.Formatter(TEXT)
