"""Each fault word of a simulated head does what its table says, and nothing after it is cleared."""

from __future__ import annotations

import contextlib
import math

import pytest

from drivers.errors import DriverError, NoReply
from drivers.faults import HEAD_WORDS, PAN_TILT
from hil_tests.drivers.fault_bench import Bench


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_head_wrong_reads_off_by_a_constant_while_the_motion_is_right(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "wrong", offset_rad=math.radians(2))
    assert bench.settled(0.3, 0.1)
    reading = bench.head.read()
    assert reading.pan_rad == pytest.approx(0.3 + math.radians(2), abs=1e-4)
    assert reading.tilt_rad == pytest.approx(0.1 + math.radians(2), abs=1e-4)
    assert bench.head.true_joints(bench.clock.now_s())[0] == pytest.approx(0.3, abs=5e-4)


def test_head_slow_takes_twenty_times_as_long(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "slow")
    bench.head.move(0.5, 0.0, 0.5)
    bench.clock.advance(10.0)  # v²/a alone takes v/a; at 1/20 of 0.5 rad/s, 0.5 rad takes 20 s
    assert bench.head.read().moving
    assert 0.1 < bench.head.read().pan_rad < 0.25
    bench.panel.clear()
    bench.clock.advance(0.01)
    bench.head.read()
    bench.clock.advance(2.0)
    assert not bench.head.read().moving, "cleared, it hurries on to its goal"
    assert bench.head.read().pan_rad == pytest.approx(0.5, abs=1e-4)


def test_head_mute_half_and_hang_up_give_no_reply(bench: Bench) -> None:
    for word in ("mute", "half"):
        bench.panel.set(PAN_TILT, word, replies=2)
        for _ in range(2):
            with pytest.raises(NoReply, match="no answer within"):
                bench.head.read()
        bench.head.read()
    bench.panel.set(PAN_TILT, "hang_up", for_s=2.0)
    with pytest.raises(NoReply, match="the line is gone"):
        bench.head.move(0.3, 0.0)
    bench.clock.advance(2.0)
    assert bench.head.read().pan_rad == 0.0, "the command did not reach it"


def test_head_drifting_reads_away_from_where_it_stands(bench: Bench) -> None:
    assert bench.settled(0.3, 0.1)
    bench.panel.set(PAN_TILT, "drifting", rate_rad_per_s=0.01, axis=0)
    bench.clock.advance(5.0)
    reading = bench.head.read()
    assert reading.pan_rad == pytest.approx(0.35, abs=1e-4)
    assert reading.tilt_rad == pytest.approx(0.1, abs=1e-4)
    assert bench.head.true_joints(bench.clock.now_s())[0] == pytest.approx(0.3, abs=5e-4)


def test_head_overload_stops_at_the_obstacle_and_says_so(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "overload", angle_rad=0.2, axis=1)
    bench.head.move(0.3, 0.4)
    bench.clock.advance(5.0)
    reading = bench.head.read()
    assert reading.faults == ("tilt: overload",) and not reading.moving
    assert reading.tilt_rad == pytest.approx(0.2, abs=1e-4)
    assert reading.pan_rad == pytest.approx(0.3, abs=1e-4)
    assert bench.settled(0.3, -0.1)
    assert bench.head.read().faults == ()


@pytest.mark.parametrize("axis", [0, 1])
def test_head_with_a_silent_servo_answers_nothing_but_moves(bench: Bench, axis: int) -> None:
    bench.panel.set(PAN_TILT, "silent", axis=axis)
    for call in (bench.head.read, lambda: bench.head.move(0.3, 0.2)):
        with pytest.raises(NoReply, match="no answer within"):
            call()
    bench.clock.advance(5.0)
    meant = [0.3, 0.2]
    meant[axis] = 0.0
    assert bench.head.true_joints(bench.clock.now_s()) == pytest.approx(meant, abs=1e-3)
    bench.panel.clear()
    assert (bench.head.read().pan_rad, bench.head.read().tilt_rad) == pytest.approx(meant, abs=1e-3)


def test_head_voltage_and_temperature_are_told(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "voltage_dip", factor=0.75)
    assert bench.head.read().faults == (
        "pan: input voltage 75% of what it should be",
        "tilt: input voltage 75% of what it should be",
    )
    bench.panel.clear()
    bench.panel.set(PAN_TILT, "temperature_ramp", rate_c_per_s=5.0, axis=0)
    bench.clock.advance(8.9)  # 35 °C and 44.5 more
    assert bench.head.read().faults == ()
    bench.clock.advance(0.15)
    assert bench.head.read().faults == ("pan: overheating, 80 °C",)


@pytest.mark.parametrize("word", sorted(HEAD_WORDS))
def test_a_cleared_head_is_as_before(bench: Bench, word: str) -> None:
    assert bench.settled(0.1, 0.0)
    bench.panel.set(PAN_TILT, word, for_s=1.0)
    with contextlib.suppress(DriverError):
        bench.head.read()
    bench.clock.advance(2.0)
    assert bench.panel.active() == ()
    bench.head.read()
    assert bench.settled(0.3, 0.1)
    reading = bench.head.read()
    assert (reading.pan_rad, reading.tilt_rad) == pytest.approx((0.3, 0.1), abs=1e-4)
    assert not reading.faults
