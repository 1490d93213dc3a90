"""The moment of a reading, worked out by hand on clocks that are turned by hand."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, cast

import pytest

from drivers.flir_ptu.axis import SeenPosition, StepAxis
from drivers.flir_ptu.conversation import Conversation
from drivers.flir_ptu.unit import measure
from drivers.servo_bus import session
from drivers.servo_bus.course import ServoSample


class TurnedClock:
    """Shows what it is set to."""

    def __init__(self, time_s: float) -> None:
        self.time_s = time_s

    def now_s(self) -> float:
        return self.time_s


class Motion:
    """Keeps a sample; has long arrived."""

    sample: ServoSample | None = None

    def take(self, sample: ServoSample) -> None:
        self.sample = sample

    def settled(self, now_s: float) -> bool:
        return True


def test_servos_are_read_in_the_middle_of_their_exchange_whatever_was_done_since() -> None:
    """Asked from 99.90 to 99.96 s, so measured at 99.93 s; told at 100 s, or 5000 s of the stamps."""
    samples = [
        ServoSample({"present_position": 10}, False, 99.90, 99.94),
        ServoSample({"present_position": 20}, False, 99.92, 99.96),
    ]
    axes = [
        SimpleNamespace(
            motion=Motion(),
            hardware_error=0,
            settings=SimpleNamespace(angle_rad=lambda counts: counts / 100),
            go_on=lambda: None,
        )
        for _ in samples
    ]
    nothing = {name: lambda *_: None for name in ("look", "heard_again")}
    watch: Any = SimpleNamespace(**nothing, faults=lambda now_s: ())
    pair: Any = SimpleNamespace(axes=axes, samples=lambda: samples, clock=TurnedClock(100.0))
    head: Any = SimpleNamespace(poll_hz=10.0, resting_poll_s=0.1)
    it = session.ServoSession(pair, watch, head, TurnedClock(5000.0))
    reading = it.read()
    assert (reading.pan_rad, reading.tilt_rad) == (0.1, 0.2)
    assert reading.time_s == pytest.approx(5000.0 - 0.07)
    assert it.poll_due_s == pytest.approx(100.1)


@dataclass
class RestingAxis:
    """Rests wherever it is seen."""

    name: str
    taken: list[SeenPosition] = field(default_factory=list)

    __hash__ = object.__hash__

    def rests_at(self, seen: SeenPosition) -> bool:
        return True

    def take(self, seen: SeenPosition) -> None:
        self.taken.append(seen)


def test_resting_axes_that_are_asked_one_after_the_other_are_told_at_the_middle_of_both() -> None:
    """Tilt is asked at 10.0 s, pan at 10.2 s; each looks when the four bytes of the question are there."""
    clock = TurnedClock(10.0)

    def ask(question: str) -> float:
        clock.time_s += 0.2
        return 7.0

    talk = cast(Conversation, SimpleNamespace(ask=ask, byte_s=0.001))
    pan, tilt = RestingAxis("pan"), RestingAxis("tilt")
    told_s = measure(talk, cast(StepAxis, pan), cast(StepAxis, tilt), clock)
    assert told_s == pytest.approx((10.004 + 10.204) / 2)
    assert [seen.time_s for axis in (pan, tilt) for seen in axis.taken] == [told_s, told_s]
