"""How long servos heard nothing is counted from what they answered last, not from what was asked last."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from drivers.clock import ManualClock
from drivers.dynamixel.watch import Watch
from drivers.errors import NoReply
from drivers.servo_bus.session import ServoSession

WATCHDOG_S, REPLY_S = 0.4, 0.1


class SilentPair:
    """Servos that answer, or let the host wait for its time-out."""

    def __init__(self, clock: ManualClock) -> None:
        self.clock = clock
        self.link = SimpleNamespace(clock=clock)
        self.axes: tuple[Any, ...] = ()
        self.answers = True

    def samples(self) -> list[Any]:
        if self.answers:
            return []
        self.link.clock.advance(REPLY_S)
        raise NoReply("no reply", device="pan")


def test_an_attempt_that_failed_within_a_look_is_a_part_of_the_silence() -> None:
    clock = ManualClock(10.0)
    pair = SilentPair(clock)
    head = SimpleNamespace(poll_hz=50.0, watchdog_counts=20, watchdog_s=WATCHDOG_S, resting_poll_s=0.1)
    watch = Watch(pair, head, SimpleNamespace())  # type: ignore[arg-type]
    session = ServoSession(pair, watch, head, clock)  # type: ignore[arg-type]
    looked: list[float] = []
    watch.look_soon = lambda: looked.append(clock.now_s())  # type: ignore[method-assign]
    watch.look = lambda: None  # type: ignore[method-assign]
    session.look()
    looked.clear()
    clock.advance(0.02)
    session.look()
    assert looked == []
    pair.answers = False
    clock.advance(0.02)
    with pytest.raises(NoReply):
        session.look()  # two attempts of a tenth of a second
    pair.answers = True
    session.look()
    assert looked == [clock.now_s()]
