"""A Dynamixel head on simulated servos, on a turned clock: start-up, faults, watchdog, unplugging.

The simulator's registers and packets are its own (``drivers/sim/wire``), not the driver's. On a real pseudo
terminal and the machine's clock are a plug that is pulled, the process that is killed, the lock of
a line that is taken, and what closing leaves open: the kernel has its part in each.
"""

from __future__ import annotations

import math
import multiprocessing as mp
import os
import signal
import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from drivers.dynamixel.head import open_head
from drivers.dynamixel.servo import Servo
from drivers.errors import (
    DriverError,
    HardwareFault,
    LineLost,
    NoReply,
    OutOfRange,
    Refused,
    WatchdogTripped,
    WrongDevice,
)
from drivers.interfaces import PanTilt
from drivers.servo_bus.port import QUIET_S
from drivers.sim.wire.dynamixel_servo import HEAT, OVERLOAD
from hil_tests.drivers.dynamixel.dynamixel_rig import (
    COUNT_RAD,
    SLOW_TO_BRAKE,
    X,
    failed,
    opened,
    read_or_none,
    rig,
)
from hil_tests.left_behind import held
from hil_tests.waiting import NET_S

# Start-up


@pytest.mark.parametrize(
    "models",
    [(X, X), (X, "mx_28"), ("mx_64", "ph42_020_s300"), ("ph54_200_s500", "xl330_m288"), ("2xl430_w250",) * 2],
)
def test_start_up_sets_the_servos_and_moves_neither(models: tuple[str, str]) -> None:
    with opened(models=models, starts_rad=(0.4, -0.3)) as (it, head):
        assert isinstance(head, PanTilt)
        reading = head.read()
        assert reading.pan_rad == pytest.approx(0.4, abs=COUNT_RAD)
        assert reading.tilt_rad == pytest.approx(-0.3, abs=COUNT_RAD)
        now_s = it.now_s()
        assert [axis.angle_rad(now_s) for axis in it.axes] == [0.4, -0.3]
        for servo, (low, high) in zip(it.servos, ((-2.5, 2.5), (-1.2, 1.0)), strict=True):
            table, count_rad, zero = servo.table, servo.model.count_rad, servo.model.zero_counts
            assert table["operating_mode"] == 3
            assert table["return_delay_time"] == 0
            assert table["torque_enable"] == 1
            assert table["bus_watchdog"] == 20  # 0.4 s in steps of 20 ms
            assert (table["min_position_limit"] - zero) * count_rad == pytest.approx(low, abs=count_rad)
            assert (table["max_position_limit"] - zero) * count_rad == pytest.approx(high, abs=count_rad)
            assert table["profile_velocity"] > 0  # 0 would mean as fast as it can
            assert table["profile_acceleration"] > 0


def test_settings_that_fit_are_not_written_again() -> None:
    with rig() as it:
        it.open().close()
        before = [dict(servo.table.values) for servo in it.servos]
        head = it.open()  # torque is still on: any permanent setting would be refused
        head.close()
        for servo, values in zip(it.servos, before, strict=True):
            assert servo.table["min_position_limit"] == values["min_position_limit"]
            assert servo.table["torque_enable"] == 1


@pytest.mark.parametrize(
    ("how", "changes", "words"),
    [
        ({"models": ("xm540_w270", X)}, {"pan": {"model": X}}, "is a XM540-W270, the configuration says"),
        ({"pan": {"torque_enable": 1}}, {}, "torque is on and the axis may fall"),
        ({"pan": {"secondary_id": 2}}, {}, "also obeys writes to id 2"),
        ({"pan": {"homing_offset": 1100}}, {}, "position mode honours 1024"),
        ({"starts_rad": (2.8, 0.0)}, {}, "outside its limits"),
        ({"starts_rad": (3.3, 0.0)}, {}, "outside its limits"),  # parked across the seam of 0 and 4095
        ({}, {"pan": {"id": 9}}, "servo 9 .* gave no usable answer to ping"),
    ],
)
def test_what_does_not_fit_is_refused_in_words_and_the_line_is_let_go(
    how: dict[str, Any], changes: dict[str, dict[str, Any]], words: str
) -> None:
    with rig(**how) as it:
        options = {**it.options, **{k: {**it.options[k], **v} for k, v in changes.items()}}
        for _ in range(2):  # the second time shows that the port was let go
            with pytest.raises((WrongDevice, NoReply), match=words):
                it.open(**options)
        now_s = it.now_s()
        assert [axis.angle_rad(now_s) for axis in it.axes] == list(how.get("starts_rad", (0.0, 0.0)))


def test_more_than_the_servo_can_is_refused_in_words() -> None:
    words = "acceleration_rad_per_s2 or speed_rad_per_s is more than"
    with rig(models=("ph42_020_s300", X)) as it, pytest.raises(WrongDevice, match=words):
        it.open(acceleration_rad_per_s2=30.0)  # 17189 rev/min2; from the factory it takes 10765


def test_a_second_close_returns_when_the_first_has_left_the_servos() -> None:
    # Else a rover that is closed beside its head takes the line away from under the last stop.
    with rig() as it:
        head = it.open()
        head.move(1.0, 0.5)
        it.clock.sleep(0.2)
        speed, first = it.speed_rad_per_s(0), it.beside(head.close)
        it.until(lambda: it.speed_rad_per_s(0) < speed, "the first to brake")
        assert [servo.table["bus_watchdog"] for servo in it.servos] != [0, 0]
        head.close()
        assert [servo.table["bus_watchdog"] for servo in it.servos] == [0, 0]
        first.wait()


def test_torque_may_be_dropped_at_the_start_where_the_configuration_allows_it() -> None:
    with opened(pan={"torque_enable": 1}, options={"torque_off_at_start": True}) as (it, head):
        assert it.servos[0].table["min_position_limit"] == 419  # 2048 - 2.5 rad, inwards
        assert head.read().faults == ()


@pytest.mark.parametrize("level", [0, 1])  # 1 answers what is read, and nothing else
def test_silent_servos_are_told_to_answer(level: int) -> None:
    with opened(pan={"status_return_level": level}) as (it, head):
        assert it.servos[0].table["status_return_level"] == 2
        assert head.read().faults == ()


def test_a_hardware_error_at_the_start_is_refused_or_rebooted_as_configured() -> None:
    with rig() as it:
        it.servos[0].raise_error(OVERLOAD)
        with pytest.raises(HardwareFault, match=r"pan .servo 1. reports overload"):
            it.open()
        head = it.open(pan={**it.options["pan"], "on_hardware_error": "reboot"})
        assert head.read().faults == ()
        head.close()


def test_an_axis_that_droops_below_its_limit_is_not_locked_out() -> None:
    with opened(starts_rad=(2.5 + 2 * COUNT_RAD, -1.2 - 3 * COUNT_RAD)) as (it, head):
        assert [servo.table["goal_position"] for servo in it.servos] == [3677, 1266]  # the limits, inwards
        assert it.settled(head).faults == ()
        head.move(2.3, -1.0)
        assert it.settled(head).tilt_rad == pytest.approx(-1.0, abs=COUNT_RAD)


def test_an_axis_farther_outside_than_it_droops_is_refused() -> None:
    with (
        rig(starts_rad=(2.5 + 8 * COUNT_RAD, 0.0)) as it,
        pytest.raises(WrongDevice, match="outside its lim"),
    ):
        it.open()


def test_what_a_killed_servo_test_has_left_is_put_right_and_told(caplog: pytest.LogCaptureFixture) -> None:
    with rig() as it:
        it.open().close()
        table = it.servos[0].table
        it.servos[0].table.values.update({"goal_pwm": 88, "bus_watchdog": 255, "profile_velocity": 8})
        head = it.open()
        assert (table["goal_pwm"], table["bus_watchdog"]) == (885, 20)
        assert table["profile_velocity"] == 41
        assert "pan (servo 1) was bound to 10 % of its drive" in caplog.text
        assert head.read().faults == ()
        head.close()


def test_a_cleared_watchdog_and_a_void_goal_go_out_together() -> None:
    with rig() as it:
        it.open().close()
        it.servos[0].table.values.update({"bus_watchdog": 255, "goal_position": 3000})
        it.ear.heard.clear()
        it.open().close()
        shouts = [n for n, (_, one) in enumerate(it.ear.heard) if one.code == 0x83]
        clear, void = it.ear.heard[shouts[0]][1], it.ear.heard[shouts[0] + 1][1]
        assert clear.parameters == bytes((98, 0, 1, 0, 1, 0))
        assert void.parameters == bytes((116, 0, 4, 0, 1)) + (2048).to_bytes(4, "little")
        written = [one.parameters[0] for _, one in it.ear.heard[: shouts[0]] if one.code == 3]
        assert not {98, 116} & set(written), "one of them went out before"


def test_a_setting_that_is_refused_with_the_torque_off_leaves_the_axis_held(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    true_wanted = Servo._wanted
    monkeypatch.setattr(Servo, "_wanted", lambda servo: {**true_wanted(servo), "temperature_limit": 200})
    with rig(pan={"torque_enable": 1}) as it:
        with pytest.raises(Refused, match="temperature_limit"):
            it.open(torque_off_at_start=True)
        assert it.servos[0].table["torque_enable"] == 1


def test_more_than_the_servo_can_is_refused_before_the_torque_is_touched() -> None:
    with rig(models=("ph42_020_s300", X), pan={"torque_enable": 1}) as it:
        with pytest.raises(WrongDevice, match="acceleration_rad_per_s2 or speed_rad_per_s is more than"):
            it.open(acceleration_rad_per_s2=30.0, torque_off_at_start=True)
        assert it.servos[0].table["torque_enable"] == 1
        sent = [one for _, one in it.ear.heard if one.code == 3 and one.parameters[:2] == b"\x00\x02"]
        assert sent == [], "torque was written"


# Moving


def test_a_speed_that_no_servo_can_be_told_is_refused_and_nothing_moves() -> None:
    with opened() as (it, head):
        with pytest.raises(OutOfRange, match=r"speed 0.005 rad/s is less than the 0.0240 rad/s"):
            head.move(0.5, 0.0, 0.005)
        assert it.servos[0].table["goal_position"] == 2048
        head.move(0.5, 0.0, 0.03)
        assert it.servos[0].table["profile_velocity"] == 1


@pytest.mark.parametrize("register", ["profile_velocity", "profile_acceleration"])
def test_a_profile_that_is_zeroed_under_way_is_noticed_and_put_right(register: str) -> None:
    with rig() as it:
        it.options["pan"].update(approach="positive", approach_rad=0.3)
        head = it.open()
        head.move(-0.3, 0.0)
        it.until(lambda: head.read().pan_rad < -0.2, "motion")
        it.servos[0].table[register] = 0  # as fast as it can
        error = it.until(lambda: failed(head), "the fault")
        assert "profile" in str(error)
        last_stretch = (2048 - round(0.3 / COUNT_RAD)).to_bytes(4, "little")
        assert not any(last_stretch in one.parameters for _, one in it.ear.heard), "the last stretch went out"
        it.until(lambda: read_or_none(head), "the head")
        assert it.servos[0].table[register] > 0
        head.close()


def test_a_move_is_sent_with_its_own_speed_and_the_configured_acceleration() -> None:
    """XM430: 214.577 rev/min2 and 0.229 rev/min a count (its table in the manufacturer's e-manual)."""
    with opened(options={"acceleration_rad_per_s2": 20.0}) as (it, head):
        head.move(0.2, -0.1, 0.8)
        it.settled(head)
        for servo in it.servos:
            assert servo.table["profile_acceleration"] == math.ceil(20.0 / (214.577 * math.tau / 3600))
            assert servo.table["profile_velocity"] == math.floor(0.8 / (0.229 * math.tau / 60))


def test_both_axes_go_to_the_nearest_count_and_the_report_says_what_is_left() -> None:
    with opened() as (it, head):
        head.move(0.5, -0.3)
        reading = it.settled(head)
        assert reading.pan_rad == pytest.approx(0.5, abs=COUNT_RAD / 2)
        report = head.report()
        for axis, commanded in (("pan", 0.5), ("tilt", -0.3)):
            assert report[axis].commanded_rad == commanded
            left_rad = report[axis].left_rad
            assert left_rad is not None
            assert abs(left_rad) <= COUNT_RAD / 2
            left_px = report[axis].left_px(1280.0)
            assert left_px is not None
            assert abs(left_px) < 1.0  # half a count is 0.98 pixels (facts, section 4)
        assert it.servos[0].table["goal_position"] == report["pan"].goal_counts


def test_a_goal_is_approached_from_the_configured_side() -> None:
    with rig() as it:
        it.options["tilt"].update(approach="positive", approach_rad=0.05)
        head = it.open()
        head.move(0.0, 0.5)
        it.settled(head)
        begun_s = it.now_s()
        head.move(0.0, 0.2)
        reading = it.settled(head)
        way = np.linspace(begun_s, it.now_s(), 500)
        assert 0.2 - 0.06 < min(it.axes[1].mechanical_rad(moment_s) for moment_s in way) < 0.2 - 0.03
        assert reading.tilt_rad == pytest.approx(0.2, abs=COUNT_RAD)
        assert head.report()["tilt"].side == "positive"
        told = head.axis_motion()
        assert (told["tilt"].turn_to(0.2), told["pan"].turn_to(0.2)) == (1, 0)
        assert told["tilt"].count_rad == pytest.approx(COUNT_RAD)
        head.close()


@pytest.mark.parametrize("goal", [(2.6, 0.0), (0.0, -1.3), (float("nan"), 0.0), (0.0, float("inf"))])
def test_goals_outside_the_limits_are_refused_before_anything_is_sent(goal: tuple[float, float]) -> None:
    with opened() as (it, head):
        with pytest.raises(OutOfRange, match="outside the head's limits"):
            head.move(*goal)
        with pytest.raises(OutOfRange, match="positive number"):
            head.move(0.0, 0.0, 0.0)
        assert it.servos[0].table["goal_position"] == 2048


def test_stop_brakes_holds_and_forgets_the_goal() -> None:
    with opened() as (it, head):
        head.move(2.0, 0.0)
        it.until(lambda: head.read().pan_rad > 0.2, "motion")
        head.stop()
        reading = it.settled(head)
        assert reading.pan_rad < 1.5
        assert head.report()["pan"].commanded_rad is None
        assert it.servos[0].table["torque_enable"] == 1


def test_stop_may_let_an_axis_go_and_a_move_takes_hold_of_it_again() -> None:
    with rig() as it:
        it.options["pan"]["at_stop"] = "torque_off"
        head = it.open()
        head.stop()
        it.until(lambda: [servo.table["torque_enable"] for servo in it.servos] == [0, 1], "torque off")
        assert head.read().faults == ()
        head.move(0.3, 0.0)
        assert it.settled(head).pan_rad == pytest.approx(0.3, abs=COUNT_RAD)
        head.close()


@pytest.mark.parametrize(("at_close", "torque"), [("hold", 1), ("torque_off", 0)])
def test_close_leaves_the_servos_as_configured(at_close: str, torque: int) -> None:
    with rig() as it:
        it.options["pan"]["at_close"] = at_close
        head = it.open()
        head.move(2.0, 0.0)
        head.close()
        assert [servo.table["torque_enable"] for servo in it.servos] == [torque, 1]
        assert [servo.table["bus_watchdog"] for servo in it.servos] == [0, 0]
        with pytest.raises(NoReply, match="closed"):
            head.read()


def test_the_watchdog_is_fed_while_nobody_calls() -> None:
    with opened() as (it, head):
        head.read()
        before = len(it.ear.heard)
        it.until(lambda: len(it.ear.heard) > before + 60, "a second of polls")
        assert it.servos[0].table["bus_watchdog"] == 20
        assert head.read().faults == ()


def test_servos_that_stand_are_read_seldom_and_often_enough_for_their_watchdog() -> None:
    with opened() as (it, head):
        it.settled(head)
        before, began_s = len(it.ear.heard), it.now_s()
        it.until(lambda: len(it.ear.heard) > before + 40, "two seconds of polls")
        assert 1.0 < it.now_s() - began_s < 3.0
        for reply_timeout_s in (0.01, 0.05, 0.2):
            patient = replace(head.settings, watchdog_s=0.3, reply_timeout_s=reply_timeout_s)
            assert patient.resting_poll_s + reply_timeout_s + QUIET_S < 0.3  # one reply may be lost


def test_fast_reads_are_used_only_after_they_proved_themselves() -> None:
    with opened(options={"fast_read": True}) as (_, head):
        assert head._session.pair.fast
        assert head.read().faults == ()
    with opened(options={"fast_read": True}, models=("mx_28", X)) as (_, head):
        assert head.read().faults == ()


# Bad days


def test_a_silent_host_stops_a_motion_and_moving_again_is_deliberate() -> None:
    with opened() as (it, head):
        head.move(2.0, 0.0)
        it.until(lambda: head.read().pan_rad > 0.1, "motion")
        stalled_s = it.now_s()
        free = it.gate()
        stalled = it.beside(lambda: head._bus.call("stall", free.wait, 60.0))
        it.until(lambda: it.servos[0].table["bus_watchdog"] == 255, "the watchdog")
        assert 0.4 - 0.1 <= it.now_s() - stalled_s <= 0.4 + 0.02, "it was fed last within a poll before"
        free.set()
        stalled.wait()
        reading = it.until(lambda: (r := read_or_none(head)) and r.faults and r, "the fault")
        assert "watchdog" in reading.faults[0]
        with pytest.raises(WatchdogTripped, match="stop arms it anew"):
            head.move(0.0, 0.0)
        it.until(lambda: it.speed_rad_per_s(0) == 0, "rest")
        stood_rad = it.angle_rad(0)
        head.stop()
        reading = it.settled(head)
        assert reading.faults == ()
        assert reading.pan_rad == pytest.approx(stood_rad, abs=2 * COUNT_RAD)  # it did not go on
        head.move(0.1, 0.0)
        assert it.settled(head).pan_rad == pytest.approx(0.1, abs=COUNT_RAD)


def test_a_silent_host_at_rest_has_interrupted_nothing() -> None:
    with opened() as (it, head):
        head.move(0.3, 0.0)
        it.settled(head)
        free = it.gate()
        stalled = it.beside(lambda: head._bus.call("stall", free.wait, 60.0))
        it.until(lambda: it.servos[0].table["bus_watchdog"] == 255, "the watchdog")
        free.set()
        stalled.wait()
        it.until(lambda: it.servos[0].table["bus_watchdog"] == 20, "the watchdog armed again")
        assert it.settled(head).faults == ()
        assert it.angle_rad(0) == pytest.approx(0.3, abs=COUNT_RAD)
        head.move(0.1, 0.0)
        assert it.settled(head).pan_rad == pytest.approx(0.1, abs=COUNT_RAD)


def drive_and_wait(path: str, options: dict[str, Any], ready: Any) -> None:
    """A process that moves the head far and is then killed."""
    head = open_head({**options, "port": path})
    head.move(2.4, 0.0)
    while not ((reading := read_or_none(head)) and reading.pan_rad > 0.05):
        pass
    ready.set()
    threading.Event().wait()


def test_a_killed_process_leaves_a_head_that_stops_by_itself() -> None:
    with rig(mechanism=SLOW_TO_BRAKE, real=True) as it:
        del it.options["acceleration_rad_per_s2"], it.options["watchdog_s"]  # as they come
        context = mp.get_context("spawn")
        ready = context.Event()
        process = context.Process(target=drive_and_wait, args=(it.line.path, it.options, ready), daemon=True)
        process.start()
        assert ready.wait(NET_S)
        assert process.pid is not None
        killed_s = it.now_s()
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        it.until(lambda: it.servos[0].table["bus_watchdog"] == 255, "the watchdog")
        it.until(lambda: it.speed_rad_per_s(0) == 0, "rest")
        # What the axis did between is known to the simulator for every moment, whenever we look.
        assert it.axes[0].velocity_rad_per_s(killed_s + 0.5) == 0
        stood_rad = it.angle_rad(0)
        assert stood_rad < 2.0
        head = it.open()  # a new start is deliberate: it arms anew, and does not go on to the old goal
        assert it.settled(head).pan_rad == pytest.approx(stood_rad, abs=2 * COUNT_RAD)
        head.move(0.0, 0.0)
        assert it.settled(head).pan_rad == pytest.approx(0.0, abs=COUNT_RAD)
        head.close()


def test_a_real_plug_that_is_pulled_is_a_lost_line_and_the_head_comes_back_by_itself() -> None:
    with opened(real=True, options={"watchdog_s": 0}) as (it, head):
        it.line.hang_up()
        error = it.until(lambda: isinstance(e := failed(head), LineLost) and e, "the fault")
        assert it.line.path in str(error)
        it.line.come_back()
        assert it.until(lambda: read_or_none(head), "the head").pan_rad == pytest.approx(0, abs=COUNT_RAD)


def test_unplugged_and_plugged_in_again_it_comes_back_without_moving() -> None:
    with opened() as (it, head):
        head.move(2.0, 0.0)
        it.until(lambda: head.read().pan_rad > 0.1, "motion")
        it.line.hang_up()
        error = it.until(lambda: failed(head), "the fault")
        assert isinstance(error, LineLost)
        assert it.line.path in str(error)
        for act in (head.read, head.stop, lambda: head.move(0.0, 0.0)):
            with pytest.raises(LineLost):
                act()
        it.until(lambda: it.servos[0].table["bus_watchdog"] == 255, "the watchdog")
        it.until(lambda: it.speed_rad_per_s(0) == 0, "rest")
        stood_rad = it.angle_rad(0)
        it.line.come_back()
        reading = it.until(lambda: read_or_none(head), "the head")
        assert reading.pan_rad == pytest.approx(stood_rad, abs=2 * COUNT_RAD)
        assert it.settled(head).faults == ()
        assert it.angle_rad(0) == pytest.approx(stood_rad, abs=2 * COUNT_RAD)
        head.move(0.1, 0.0)
        assert it.settled(head).pan_rad == pytest.approx(0.1, abs=COUNT_RAD)


def test_a_servo_that_lost_its_power_is_set_up_anew() -> None:
    with opened() as (it, head):
        servo = it.servos[1]
        servo.set_power(False, it.now_s())
        assert isinstance(it.until(lambda: failed(head), "the fault"), DriverError)
        servo.set_power(True, it.now_s())
        assert servo.table["profile_velocity"] == 0  # as fast as it can: must not be left so
        it.until(lambda: read_or_none(head), "the head")
        assert servo.table["profile_velocity"] > 0
        assert servo.table["torque_enable"] == 1
        assert servo.table["bus_watchdog"] == 20
        head.move(0.0, 0.2)
        assert it.settled(head).tilt_rad == pytest.approx(0.2, abs=COUNT_RAD)


def test_a_servo_that_is_exchanged_is_refused_when_it_comes_back() -> None:
    with opened() as (it, head):
        it.line.hang_up()
        it.servos[0].table["model_number"] = 1120
        it.servos[0].model = it.servos[0].model.__class__(**{**vars_of(it.servos[0].model), "number": 1120})
        it.line.come_back()
        error = it.until(lambda: isinstance(e := failed(head), WrongDevice) and e, "the refusal")
        assert "XM540-W270" in str(error)


def vars_of(instance: Any) -> dict[str, Any]:
    return {name: getattr(instance, name) for name in instance.__dataclass_fields__}


def test_a_hardware_error_is_a_fault_stops_the_other_axis_and_blocks_moves() -> None:
    with opened() as (it, head):
        head.move(2.0, 0.9)
        it.until(lambda: head.read().pan_rad > 0.1, "motion")
        it.servos[1].raise_error(OVERLOAD)
        reading = it.until(lambda: (r := head.read()).faults and r, "the fault")
        assert reading.faults[0].startswith("tilt (servo 2) reports overload (hardware error 0x20)")
        assert "torque is off" in reading.faults[0]
        assert it.settled(head).pan_rad < 1.9
        with pytest.raises(HardwareFault, match="overload"):
            head.move(0.0, 0.0)
        head.stop()  # must work all the same


def test_a_hardware_error_is_rebooted_away_where_the_configuration_says_so() -> None:
    with rig() as it:
        for axis in ("pan", "tilt"):
            it.options[axis]["on_hardware_error"] = "reboot"
        head = it.open()
        it.servos[0].raise_error(HEAT)
        it.until(lambda: failed(head), "the fault")
        reading = it.until(lambda: read_or_none(head), "the head")
        assert reading.faults == ()
        assert it.servos[0].table["hardware_error_status"] == 0
        assert it.servos[0].table["torque_enable"] == 1
        head.close()


def test_a_supply_that_stays_low_reboots_a_servo_three_times_and_no_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("drivers.absent.LONGEST_WAIT_S", 0.1)
    monkeypatch.setattr("drivers.sim.wire.dynamixel_servo.BOOT_S", 0.02)
    with rig() as it:
        for axis in ("pan", "tilt"):
            it.options[axis]["on_hardware_error"] = "reboot"
        head = it.open(reply_timeout_s=0.05)
        it.panel.set("pan_tilt", "voltage_dip")

        def codes() -> list[int]:
            return [instruction.code for _, instruction in it.ear.heard]

        def asked_who(since: int) -> int:
            return sum(one.code == 2 and one.parameters[:2] == b"\0\0" for _, one in it.ear.heard[since:])

        reboot = 8
        it.until(lambda: codes().count(reboot) >= 3, "three reboots")
        third = [n for n, code in enumerate(codes()) if code == reboot][2]
        it.until(lambda: asked_who(third) > 10, "more tries")
        assert codes().count(reboot) == 3
        assert isinstance(failed(head), HardwareFault)
        head.close()


def test_a_setting_changed_behind_the_drivers_back_is_noticed_and_put_right() -> None:
    with opened() as (it, head):
        it.servos[0].table["torque_enable"] = 0
        it.until(lambda: failed(head), "the fault")
        it.until(lambda: read_or_none(head), "the head")
        assert it.servos[0].table["torque_enable"] == 1


def test_two_heads_cannot_have_one_line() -> None:
    with opened(real=True) as (it, _), pytest.raises(LineLost, match="held by another program"):
        it.open()


def test_closing_leaves_no_thread_and_no_descriptor() -> None:
    with rig(real=True) as it:
        it.open().close()
        before = held()
        for _ in range(3):
            it.open().close()
        assert held() <= before
