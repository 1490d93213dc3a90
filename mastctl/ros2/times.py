"""ROS time of the daemon's monotonic seconds: the offset between the two, and a watch over it.

A stamp is the daemon's CLOCK_MONOTONIC time plus an offset, in whole nanoseconds. On the daemon's own machine
the offset is that of two clocks of this machine, and no message is part of it. Elsewhere it comes from the
quickest of the newest exchanges, in the middle of its round trip.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from dataclasses import dataclass

log = logging.getLogger(__name__)

NS = 1_000_000_000
STEP_S = 1e-3
"""A smaller change of the offset is taken without a word; on one machine only a set clock is larger."""
SAME_S = 1e-4
EXCHANGES = 30
CALM = 60
"""Exchanges without a step after which the offset counts as steady again."""


@dataclass(frozen=True)
class ClockExchange:
    """One question for the daemon's time.

    Attributes
    ----------
    sent_s, got_s
        This machine's monotonic time of question and answer, seconds.
    now_s
        The daemon's monotonic time between them, seconds.
    real_ns
        What is to be added to this machine's monotonic nanoseconds for its real time.
    """

    sent_s: float
    now_s: float
    got_s: float
    real_ns: int

    @property
    def here(self) -> bool:
        """Whether both clocks are one."""
        return self.sent_s - SAME_S <= self.now_s <= self.got_s + SAME_S

    @property
    def half_s(self) -> float:
        """How far the offset may be off, seconds."""
        return 0.0 if self.here else 0.5 * (self.got_s - self.sent_s)

    @property
    def offset_ns(self) -> int:
        """What is to be added to the daemon's monotonic nanoseconds for this machine's real time."""
        if self.here:
            return self.real_ns
        return self.real_ns + round((0.5 * (self.sent_s + self.got_s) - self.now_s) * NS)


def real_from_monotonic_ns() -> int:
    """Return this machine's real time less its monotonic one, nanoseconds: the closest of five."""
    found = []
    for _ in range(5):
        before = time.monotonic_ns()
        real = time.time_ns()
        after = time.monotonic_ns()
        found.append((after - before, real - (before + after) // 2))
    return min(found)[1]


class RosTime:
    """Stamps of the daemon's times; `heard` once a second keeps the offset. Read from any thread.

    Attributes
    ----------
    exchange
        The one in use, None before the first.
    steps
        How often the offset has changed by more than its doubt: a clock was set, or the daemon's runs
        otherwise than real time (a simulation at full speed).
    """

    def __init__(self) -> None:
        self.exchange: ClockExchange | None = None
        self.steps = 0
        self._since_step = CALM
        self._kept: deque[ClockExchange] = deque(maxlen=EXCHANGES)

    def heard(self, new: ClockExchange) -> bool:
        """Take one more exchange; return whether the offset is another one than before."""
        old = self.exchange
        self._since_step += 1
        if old is not None:
            off_s = abs(new.offset_ns - old.offset_ns) / NS
            if off_s > STEP_S + new.half_s + old.half_s:
                if self.steady:  # a clock that runs otherwise than real time is reported once
                    log.warning("the offset of ROS time from the daemon's clock changed by %.6f s", off_s)
                self.steps += 1
                self._since_step = 0
                self._kept.clear()
        self._kept.append(new)
        self.exchange = new if new.here else min(self._kept, key=lambda one: one.half_s)
        return old is None or old.offset_ns != self.exchange.offset_ns

    def stamp_ns(self, monotonic_s: float) -> int | None:
        """Return the ROS time of one of the daemon's times, nanoseconds; None before the first exchange."""
        return None if self.exchange is None else round(monotonic_s * NS) + self.exchange.offset_ns

    @property
    def steady(self) -> bool:
        """Whether the offset is known and has not changed for the last `CALM` exchanges."""
        return self.exchange is not None and self._since_step >= CALM
