"""Each fault word of a simulated head does what its table says, and nothing after it is cleared."""

from __future__ import annotations

import contextlib
import math

import numpy as np
import pytest

from drivers.errors import BadReply, DriverError, NoReply
from drivers.faults import HEAD_WORDS, PAN_TILT
from drivers.sim.pan_tilt import REPLY_TIMEOUT_S
from hil_tests.drivers.fault_bench import Bench
from hil_tests.waiting import until
from tools.campaigns.servo_rigs import dynamixel, ptu


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_head_off_gives_no_reply_and_stands_still(bench: Bench) -> None:
    bench.head.move(1.0, 0.2)
    bench.clock.advance(0.5)
    where = bench.head.true_joints(bench.clock.now_s())
    bench.panel.set(PAN_TILT, "off")
    for call in (bench.head.read, bench.head.stop, lambda: bench.head.move(0.0, 0.0)):
        before_s = bench.clock.now_s()
        with pytest.raises(NoReply, match=r"no answer within 0\.1 s"):
            call()
        assert bench.clock.now_s() - before_s == pytest.approx(REPLY_TIMEOUT_S)
    assert bench.head.true_joints(bench.clock.now_s()) == pytest.approx(where, abs=1e-9)
    bench.panel.clear(PAN_TILT)
    assert bench.settled(0.3, 0.1)
    assert bench.head.read().pan_rad == pytest.approx(0.3, abs=1e-4)


@pytest.mark.parametrize("moving", [False, True])
def test_head_stuck_takes_moves_but_stays(bench: Bench, moving: bool) -> None:
    assert bench.settled(0.3, 0.1)
    bench.panel.set(PAN_TILT, "stuck", moving=moving)
    before = bench.head.read()
    truth = bench.head.true_joints(bench.clock.now_s())
    bench.head.move(-0.5, -0.5)
    bench.clock.advance(5.0)
    after = bench.head.read()
    assert (after.pan_rad, after.tilt_rad) == (before.pan_rad, before.tilt_rad)
    assert after.moving is moving
    assert bench.head.true_joints(bench.clock.now_s()) == truth
    bench.panel.clear()
    bench.clock.advance(5.0)
    assert bench.head.read().pan_rad == before.pan_rad, "the goals it ignored are forgotten"
    assert bench.settled(-0.5, -0.5)


def test_head_stuck_while_under_way_stops_where_the_fault_began(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "stuck", after_s=0.5)
    bench.head.move(1.0, 0.0)
    bench.clock.advance(3.0)
    reference = Bench()
    reference.head.move(1.0, 0.0)
    reference.clock.advance(0.5)
    assert bench.head.read().pan_rad == pytest.approx(reference.head.read().pan_rad, abs=1e-9)


def test_head_garbage_is_plainly_absurd(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "garbage", seed=2)
    angles = [bench.head.read().pan_rad for _ in range(40)]
    assert any(math.isnan(a) for a in angles) and any(abs(a) > math.pi for a in angles)
    assert np.ptp([a for a in angles if math.isfinite(a) and abs(a) <= math.pi]) > 1.0
    bench.panel.clear()
    assert bench.head.read().pan_rad == 0.0


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


def test_head_delayed_answers_late_with_the_reading_of_the_call(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "delayed", delay_s=0.5)
    asked_s = bench.clock.now_s()
    reading = bench.head.read()
    assert reading.time_s == asked_s and bench.clock.now_s() == asked_s + 0.5
    bench.head.move(0.2, 0.0)
    assert bench.head.true_joints(bench.clock.now_s())[0] > 0.05, "the command itself was not late"


def test_head_intermittent_fails_some_calls(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "intermittent", probability=0.3, seed=1)
    failures = 0
    for _ in range(300):
        try:
            bench.head.read()
        except NoReply:
            failures += 1
    assert 60 < failures < 120, "0.3 of 300, four sigma either way"


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


def test_head_mute_did_what_it_was_asked(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "mute")
    with pytest.raises(NoReply):
        bench.head.move(0.3, 0.0)
    bench.clock.advance(5.0)
    assert bench.head.read().pan_rad == pytest.approx(0.3, abs=1e-4)


@pytest.mark.parametrize("word", ["corrupt", "swapped"])
def test_head_damaged_replies_are_bad_ones(bench: Bench, word: str) -> None:
    bench.panel.set(PAN_TILT, word)
    with pytest.raises(BadReply, match=word):
        bench.head.read()
    bench.head.read()


@pytest.mark.parametrize("word", ["duplicate", "noise"])
def test_head_harmless_faults_of_a_line_do_nothing_in_memory(bench: Bench, word: str) -> None:
    bench.panel.set(PAN_TILT, word, replies=5)
    assert bench.head.read().pan_rad == 0.0


def test_head_late_replies_come_late_or_too_late(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "late", delay_s=REPLY_TIMEOUT_S / 2)
    asked_s = bench.clock.now_s()
    assert bench.head.read().time_s == asked_s
    assert bench.clock.now_s() == pytest.approx(asked_s + REPLY_TIMEOUT_S / 2)
    bench.panel.set(PAN_TILT, "late", delay_s=10.0)
    with pytest.raises(NoReply):
        bench.head.read()
    assert bench.clock.now_s() == pytest.approx(asked_s + REPLY_TIMEOUT_S * 1.5), "nobody waits longer"


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
def test_head_with_one_silent_servo_answers_nothing_while_the_other_obeys(bench: Bench, axis: int) -> None:
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


def test_head_not_a_number_is_one_axis_or_both_and_the_motion_is_right(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "not_a_number", axis=1)
    bench.head.move(0.3, 0.2)
    bench.clock.advance(5.0)
    reading = bench.head.read()
    assert reading.pan_rad == pytest.approx(0.3, abs=1e-3) and math.isnan(reading.tilt_rad)
    bench.panel.set(PAN_TILT, "not_a_number")
    assert math.isnan(bench.head.read().pan_rad)
    bench.panel.clear()
    assert bench.head.read().tilt_rad == pytest.approx(0.2, abs=1e-3)


def test_a_bus_with_one_silent_servo_ends_in_no_reply_and_the_other_one_moves_on() -> None:
    with dynamixel(watchdog_s=0, turned=True) as rig:
        rig.head.move(0.1, 0.1)
        rig.panel.set(PAN_TILT, "silent", axis=1)
        with pytest.raises(DriverError):
            for _ in range(20):
                rig.head.read()
        rig.panel.clear()

        def back() -> bool:
            with contextlib.suppress(DriverError):
                return math.isfinite(rig.head.read().tilt_rad)
            return False

        until(back, "the way back", clock=rig.clock)


def test_a_unit_that_tells_no_number_ends_in_a_bad_reply() -> None:
    with ptu(turned=True) as rig:
        rig.head.read()
        rig.panel.set(PAN_TILT, "not_a_number", axis=0)
        with pytest.raises(BadReply):
            rig.head.read()
        rig.panel.clear()
        assert math.isfinite(rig.head.read().pan_rad)


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
