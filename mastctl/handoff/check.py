"""The mast's self-check in service: hand-offs are written down, and what they say together is at hand.

The record's file may hang or be full: a thread of its own reads and writes it, and nobody waits for that.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from calib.errors import BadFile
from calib.matching.handed_over import HandoffBias, MatchedHandoff, handoff_bias
from drivers.clock import Clock, SystemClock
from mastctl.handoff.log import HandoffLog, bias_told, read_log
from mastctl.state.faults import StandingFault

log = logging.getLogger(__name__)

NAME = "handoff_log"
KEPT = 2000
"""Newest hand-offs that count, and that wait for a file that cannot be written."""
SLOW_S = 5.0  # a file that takes longer than this is a fault
CLOSE_S = 2.0


class HandoffCheck:
    """What hand-offs say of the mast file in use; safe to use from any thread, never waits for a file.

    Parameters
    ----------
    path
        The record, read at the start and appended to; None: only what comes is known.
    digest
        Of the mast file in use.
    clock
        Dates the faults.
    file_time
        What the file's slowness is measured by; the machine's own clock by default: a file is real, also
        beside a simulation whose time goes by faster.
    """

    def __init__(self, path: Path | None, digest: str, clock: Clock, file_time: Clock | None = None) -> None:
        self._path = path
        self._clock = clock
        self._file_time = file_time or SystemClock()
        self._lock = threading.Lock()
        self._handoffs: deque[MatchedHandoff] = deque(maxlen=KEPT)
        self._digest = digest
        self._judged: tuple[int, tuple[HandoffBias, ...]] = (0, ())  # how many count, what stands out
        self._unread: StandingFault | None = None
        self._unwritten: StandingFault | None = None
        # Since when the file has not answered: by the clock, and by the file's time.
        self._asked_s: tuple[float, float] | None = None
        self._queue: SimpleQueue[MatchedHandoff | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._work, name=NAME, daemon=True)
        if path is not None:
            self._thread.start()

    def add(self, handoff: MatchedHandoff) -> None:
        """Count a hand-off, and have it written down."""
        with self._lock:
            self._handoffs.append(handoff)
            news = self._judge()
        _tell(news)
        if self._path is not None:
            self._queue.put(handoff)

    def use_mast(self, digest: str) -> None:
        """Count only the hand-offs of this mast file from now on."""
        with self._lock:
            self._digest = digest
            news = self._judge()
        _tell(news)

    def told(self) -> dict[str, Any]:
        """Return how many hand-offs of the mast file count, and the offsets that stand out, as JSON."""
        counted, offsets = self._judged
        return {"handoffs": counted, "offsets": [bias_told(one) for one in offsets]}

    def faults(self) -> tuple[StandingFault, ...]:
        """Return what is wrong with the record's file."""
        faults = [one for one in (self._unread, self._unwritten) if one is not None]
        asked_s = self._asked_s
        if asked_s is not None and self._file_time.now_s() - asked_s[1] > SLOW_S:
            faults.append(
                StandingFault(
                    NAME,
                    "slow",
                    f"{self._path} does not answer; hand-offs wait for it",
                    asked_s[0],
                    "the file answers",
                )
            )
        return tuple(faults)

    def close(self) -> None:
        """Write down what waits; bounded."""
        if self._path is None:
            return
        self._queue.put(None)
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            log.error("%s does not answer; the newest hand-offs are not written down", self._path)

    def _judge(self) -> list[HandoffBias]:
        """Sum up anew and return what stands out newly; the lock is held, so nothing is logged here."""
        those = [one for one in self._handoffs if one.mast_digest == self._digest]
        known = {(one.source, one.camera) for one in self._judged[1]}
        offsets = tuple(one for one in handoff_bias(those) if one.significant)
        self._judged = sum(bool(one.found) for one in those), offsets
        return [one for one in offsets if (one.source, one.camera) not in known]

    # In the file's thread

    def _work(self) -> None:
        assert self._path is not None
        self._read(self._path)
        writer = HandoffLog(self._path)
        waiting: deque[MatchedHandoff] = deque(maxlen=KEPT)
        while True:
            handoff = self._queue.get()
            if handoff is not None:
                waiting.append(handoff)
            self._write(writer, waiting)
            if handoff is None:
                return

    def _read(self, path: Path) -> None:
        self._ask()
        try:
            before = read_log(path).handoffs if path.is_file() else ()
        except (BadFile, OSError) as error:
            words = f"{' '.join(str(error).split())}; what was written down before does not count"
            with self._lock:
                self._unread = StandingFault(
                    NAME, "unreadable", words, self._clock.now_s(), "the file is right at the next start"
                )
            log.error("%s", words)
            before = ()
        with self._lock:
            self._handoffs = deque((*before, *self._handoffs), maxlen=KEPT)
            news = self._judge()
        _tell(news)
        self._answered()

    def _write(self, writer: HandoffLog, waiting: deque[MatchedHandoff]) -> None:
        """Write down what waits, oldest first, as far as it goes."""
        words = ""
        self._ask()
        while waiting and not words:
            try:
                writer.append(waiting[0])
                waiting.popleft()
            except BadFile as error:
                words = f"{' '.join(str(error).split())}; hand-offs count, and wait to be written down"
            except ValueError as error:
                log.error("a hand-off cannot be written down: %s", error)
                waiting.popleft()
        self._answered()
        with self._lock:
            before = self._unwritten
            since_s = self._clock.now_s() if before is None else before.since_s
            self._unwritten = (
                StandingFault(NAME, "unwritable", words, since_s, "a hand-off is written down")
                if words
                else None
            )
        if words and before is None:
            log.error("%s", words)

    def _ask(self) -> None:
        with self._lock:
            self._asked_s = self._clock.now_s(), self._file_time.now_s()

    def _answered(self) -> None:
        with self._lock:
            self._asked_s = None


def _tell(news: list[HandoffBias]) -> None:
    for one in news:
        log.warning("hand-offs tell an offset: %s", one.sentence)
