"""The calibration's health in service: pointings are kept and judged, in a thread that nobody waits for."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from calib.errors import BadFile, CalibError
from calib.files.mast_file import StoredRig
from mastctl.health.journal import FILE, Journal
from mastctl.health.measured import Measured, measured_by
from mastctl.health.verdict import NOTHING_YET, Verdict, verdict_of
from mastctl.health.windows import DAY_S, DAYS, KEPT, Judged, Windows
from mastctl.operations.records import Operation

log = logging.getLogger(__name__)

TOLD = 50
"""Newest pointings that are told one by one."""
CLOSE_S = 2.0


class CalibrationHealth:
    """What pointings say of the mast file in use; safe to use from any thread, never waits for a file.

    Parameters
    ----------
    folder
        Where the pointings of the last days are kept.
    mast
        The mast file in use.
    wall_s
        The time of day, seconds since 1970: pointings of a week ago may be from before a restart.
    """

    def __init__(self, folder: Path, mast: StoredRig, wall_s: Callable[[], float] = time.time) -> None:
        self._journal = Journal(folder / FILE)
        self._wall_s = wall_s
        self._mast = mast
        self._known: deque[Measured] = deque(maxlen=KEPT)
        self._windows: Windows | None = None
        self._judges_by = mast  # in the thread: it comes to the one in use by and by
        self._newest: tuple[Judged, ...] = ()
        self._not_kept = ""
        self.verdict = NOTHING_YET
        self._queue: SimpleQueue[Measured | StoredRig | None] = SimpleQueue()
        self._queue.put(self._mast)
        self._thread = threading.Thread(target=self._work, name="calibration health", daemon=True)
        self._thread.start()

    def ended(self, mast: StoredRig, operation: Operation) -> None:
        """Keep what a pointing measured, if it did; ``mast`` was in use when it began."""
        one = measured_by(operation, mast, self._wall_s())
        if one is not None:
            self._queue.put(one)

    def use_mast(self, mast: StoredRig) -> None:
        """Judge by this mast file from now on."""
        self._mast = mast
        self.verdict, self._newest = NOTHING_YET, ()
        self._queue.put(self._mast)

    def told(self) -> dict[str, Any]:
        """Return all that is known, as ``GET /calibration/health`` tells it."""
        return self.verdict.told_whole() | {
            "not_kept": self._not_kept or None,
            "newest": [
                {
                    **one.measured.told(),
                    "sigma_px": list(one.sigma_px),
                    "square": one.square,
                }
                for one in reversed(self._newest)
            ],
        }

    def close(self) -> None:
        """Write down what waits; bounded."""
        self._queue.put(None)
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            log.error("%s does not answer; the newest pointings are not kept", self._journal.path)

    # In the thread

    def _work(self) -> None:
        try:
            self._known.extend(self._journal.read())
        except BadFile as error:
            log.error("%s; pointings from before do not count", error)
        while (news := self._queue.get()) is not None:
            try:
                self._take(news)
            except Exception:  # a pointing that nobody foresaw must not end the watch
                log.exception("the calibration's health met a defect of the program")

    def _take(self, news: Measured | StoredRig) -> None:
        now_s = self._wall_s()
        if isinstance(news, Measured):
            self._known.append(news)
            self._keep(news, now_s)
            if self._windows is not None:
                self._windows.add(news)
        else:
            self._judges_by = news
            try:
                self._windows = Windows(news.rig, news.digest)
            except CalibError as error:
                self._windows = None
                self._say(Verdict("unknown", f"residuals are kept, and judged by nothing: {error}"), ())
            else:
                for one in self._known:
                    self._windows.add(one)
        windows = self._windows
        if windows is not None:
            windows.forget(now_s)
            pointings = windows.pointings
            self._say(verdict_of(windows.evidence(), len(pointings)), tuple(pointings[-TOLD:]))

    def _say(self, verdict: Verdict, newest: tuple[Judged, ...]) -> None:
        """Let a verdict be known, unless another mast file is in use by now."""
        if self._judges_by is not self._mast:
            return
        before, self.verdict, self._newest = self.verdict, verdict, newest
        if verdict.word == "drifts" and before.word != "drifts":
            log.warning("the calibration drifts: %s", verdict.sentence)
        elif before.word == "drifts" and verdict.word != "drifts":
            log.info("the calibration does not drift any more: %s", verdict.sentence)

    def _keep(self, one: Measured, now_s: float) -> None:
        """Write a pointing down; what cannot be written is said once."""
        counting = [kept for kept in self._known if kept.time_s > now_s - DAYS * DAY_S]
        try:
            self._journal.add(one, counting)
        except BadFile as error:
            if not self._not_kept:
                log.error("%s; pointings count, and are not kept over a restart", error)
            self._not_kept = str(error)
        else:
            self._not_kept = ""
