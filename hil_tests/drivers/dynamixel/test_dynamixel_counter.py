"""The servo's counter against our clock: which answers can be of their question. Times are made by hand."""

from __future__ import annotations

import random

import pytest

from drivers.dynamixel.link import Counter

PERIOD_S, WIRE_S = 0.02, 0.002


def shown(time_s: float, rate: float = 1.0) -> int:
    """What a counter that began at time 0 shows: e-manual, Realtime Tick, 1 ms, 0 to 32767."""
    return int(1000 * rate * time_s) % 32768


@pytest.mark.parametrize("rate", [0.98, 1.0, 1.02])
def test_a_true_answer_follows_the_servos_own_clock(rate: float) -> None:
    counter, now_s = Counter(shown(100.0, rate), 100.0, 100.0 + WIRE_S), 100.0
    for _ in range(3000):  # 60 s: the counter wraps at 32.768 s
        now_s += PERIOD_S
        measured_s = now_s + random.Random(now_s).random() * WIRE_S
        assert counter.mismatch(shown(measured_s, rate), now_s, now_s + WIRE_S) == ""


@pytest.mark.parametrize("late_s", [0.01, 0.02, 0.5, 16.0])
def test_an_answer_from_another_moment_is_doubted_and_not_remembered(late_s: float) -> None:
    counter = Counter(shown(100.0), 100.0, 100.0 + WIRE_S)
    now_s = 100.0 + PERIOD_S
    assert "from another moment" in counter.mismatch(shown(now_s - late_s), now_s, now_s + WIRE_S)
    assert counter.mismatch(shown(now_s), now_s, now_s + WIRE_S) == ""


def test_a_servo_that_restarted_is_doubted() -> None:
    counter = Counter(shown(100.0), 100.0, 100.0 + WIRE_S)
    assert counter.mismatch(3, 100.0 + PERIOD_S, 100.0 + PERIOD_S + WIRE_S)


def test_answers_that_are_each_a_little_later_do_not_carry_it_along() -> None:
    counter, now_s, late_s = Counter(shown(100.0), 100.0, 100.0 + WIRE_S), 100.0, 0.0
    while not counter.mismatch(shown(now_s - late_s), now_s, now_s + 0.05):  # each asked for as long as 50 ms
        now_s, late_s = now_s + PERIOD_S, late_s + 0.001
        assert late_s < 0.2, "the counter was carried along"
    assert late_s < 0.1


def test_after_a_slow_answer_the_quick_ones_before_it_still_count() -> None:
    counter, now_s = Counter(shown(100.0), 100.0, 100.0 + WIRE_S), 100.0 + PERIOD_S
    assert counter.mismatch(shown(now_s), now_s, now_s + 0.3) == ""
    now_s += PERIOD_S
    assert counter.mismatch(shown(now_s - 0.02), now_s, now_s + WIRE_S)
