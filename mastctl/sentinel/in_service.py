"""The sentinel's findings as the status tells them: read by a thread, so that nobody waits for a file."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mastctl.sentinel.folder import LOOKS, REFERENCE
from mastctl.sentinel.standing import age_s, findings

log = logging.getLogger(__name__)

POLL_S = 2.0
ANEW_S = 60.0
"""Sentences hold how long ago something was, and are made anew so often."""

CLOSE_S = 2.0


class SentinelFindings:
    """What the looks in a folder say, as of a few seconds ago; reading it waits for nothing.

    Parameters
    ----------
    folder
        Where a sentinel keeps its reference and looks; need not be there.
    mast_digest
        Returns that of the mast file in use.
    """

    def __init__(self, folder: Path, mast_digest: Callable[[], str]) -> None:
        self._folder = folder
        self._mast_digest = mast_digest
        self._found: dict[str, Any] | None = None
        self._level = "none"
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._work, name="sentinel findings", daemon=True)
        self._thread.start()

    def told(self) -> dict[str, Any] | None:
        """Return what ``GET /sentinel`` tells, None before it was read for the first time."""
        found = self._found
        if found is None or found["last_look"] is None:
            return found
        age = age_s(found["last_look"], datetime.now(UTC))
        return {**found, "age_s": None if age is None else max(age, 0.0)}

    def close(self) -> None:
        """Read no more; bounded."""
        self._ended.set()
        self._thread.join(CLOSE_S)

    # In the thread

    def _work(self) -> None:
        known: object = None
        while True:
            mark = self._mark(), self._mast_digest(), datetime.now(UTC).timestamp() // ANEW_S
            if mark != known:
                known = mark
                try:
                    self._say(findings(self._folder, mark[1]))
                except Exception:  # a file that nobody foresaw must not end the watch
                    log.exception("the sentinel's findings in %s met a defect of the program", self._folder)
            if self._ended.wait(POLL_S):
                return

    def _mark(self) -> tuple[tuple[int, int] | None, ...]:
        """What changes whenever one of the files does."""
        marks: list[tuple[int, int] | None] = []
        for name in (REFERENCE, LOOKS):
            try:
                about = (self._folder / name).stat()
            except OSError:
                marks.append(None)
            else:
                marks.append((about.st_mtime_ns, about.st_size))
        return tuple(marks)

    def _say(self, found: dict[str, Any]) -> None:
        """Let findings be known; a change that comes or goes is logged."""
        before, self._level, self._found = self._level, found["level"], found
        if self._level == "bad" and before != "bad":
            log.warning("drift sentinel: %s", found["sentence"])
        elif before == "bad" and self._level != "bad":
            log.info("drift sentinel: %s", found["sentence"])
