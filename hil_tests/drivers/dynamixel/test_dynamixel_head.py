"""A Dynamixel head on simulated servos, on a turned clock: start-up, faults, watchdog, unplugging.

The simulator's registers and packets are its own (``drivers/sim/wire``), not the driver's.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from drivers.errors import (
    DriverError,
    HardwareFault,
    NoReply,
    OutOfRange,
    WatchdogTripped,
    WrongDevice,
)
from drivers.interfaces import PanTilt
from drivers.servo_bus.port import QUIET_S
from drivers.sim.wire.dynamixel_servo import HEAT, OVERLOAD
from hil_tests.drivers.dynamixel.dynamixel_rig import (
    COUNT_RAD,
    X,
    failed,
    faults_of,
    opened,
    read_or_none,
    rig,
)

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


@pytest.mark.parametrize(
    ("how", "changes", "words"),
    [
        ({"models": ("xm540_w270", X)}, {"pan": {"model": X}}, "is a XM540-W270, the configuration says"),
        ({"pan": {"torque_enable": 1}}, {}, "torque is on and the axis may fall"),
        ({"pan": {"secondary_id": 2}}, {}, "also obeys writes to id 2"),
        ({"pan": {"homing_offset": 1100}}, {}, "position mode honours 1024"),
        ({"starts_rad": (3.3, 0.0)}, {}, "outside its limits"),  # parked across the seam of 0 and 4095
        ({}, {"pan": {"id": 9}}, "servo 9 .* gave no usable answer to ping"),
    ],
)
def test_what_does_not_fit_is_refused_and_the_line_is_let_go(
    how: dict[str, Any], changes: dict[str, dict[str, Any]], words: str
) -> None:
    with rig(**how) as it:
        options = {**it.options, **{k: {**it.options[k], **v} for k, v in changes.items()}}
        for _ in range(2):  # the second time shows that the port was let go
            with pytest.raises((WrongDevice, NoReply), match=words):
                it.open(**options)
        now_s = it.now_s()
        assert [axis.angle_rad(now_s) for axis in it.axes] == list(how.get("starts_rad", (0.0, 0.0)))


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


@pytest.mark.parametrize("level", [0, 1])  # 1 answers what is read, and nothing else
def test_silent_servos_are_told_to_answer(level: int) -> None:
    with opened(pan={"status_return_level": level}) as (it, head):
        assert it.servos[0].table["status_return_level"] == 2
        assert head.read().faults == ()


def test_a_hardware_error_at_the_start_is_refused_or_rebooted() -> None:
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


def test_what_a_killed_servo_test_has_left_is_put_right(caplog: pytest.LogCaptureFixture) -> None:
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


# Moving


def test_a_speed_below_the_servos_unit_is_refused() -> None:
    with opened() as (it, head):
        with pytest.raises(OutOfRange, match=r"speed 0.005 rad/s is less than the 0.0240 rad/s"):
            head.move(0.5, 0.0, 0.005)
        assert it.servos[0].table["goal_position"] == 2048
        head.move(0.5, 0.0, 0.03)
        assert it.servos[0].table["profile_velocity"] == 1


@pytest.mark.parametrize("register", ["profile_velocity", "profile_acceleration"])
def test_a_profile_zeroed_under_way_is_noticed_and_put_right(register: str) -> None:
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


def test_a_readings_angles_are_of_the_middle_of_its_exchange() -> None:
    late_s = 0.04
    with opened(options={"speed_rad_per_s": 1.0}) as (it, head):
        head.move(2.0, 0.0)
        it.until(lambda: it.speed_rad_per_s(0) > 0.9, "the full speed")
        it.panel.set("pan_tilt", "late", replies=1000, delay_s=late_s)
        for _ in range(5):
            reading = head.read()
            truth_rad = it.axes[0].angle_rad(reading.time_s)
            assert reading.pan_rad == pytest.approx(truth_rad, abs=1.0 * late_s / 2 + COUNT_RAD)


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
        told = head.info.motion
        assert (told["tilt"].turn_to(0.2), told["pan"].turn_to(0.2)) == (1, 0)
        assert told["tilt"].count_rad == pytest.approx(COUNT_RAD)
        head.close()


def test_resting_servos_are_read_often_enough_for_their_watchdog() -> None:
    with opened() as (it, head):
        it.settled(head)
        before, began_s = len(it.ear.heard), it.now_s()
        it.until(lambda: len(it.ear.heard) > before + 40, "two seconds of polls")
        assert 1.0 < it.now_s() - began_s < 3.0
        for reply_timeout_s in (0.01, 0.05, 0.2):
            patient = head.settings.model_copy(update={"watchdog_s": 0.3, "reply_timeout_s": reply_timeout_s})
            assert patient.resting_poll_s + reply_timeout_s + QUIET_S < 0.3  # one reply may be lost


# Bad days


def test_a_silent_host_stops_a_motion_until_a_deliberate_move() -> None:
    with opened() as (it, head):
        head.move(2.0, 0.0)
        it.until(lambda: head.read().pan_rad > 0.1, "motion")
        stalled_s = it.now_s()
        with it.host.hanging():
            it.until(lambda: it.servos[0].table["bus_watchdog"] == 255, "the watchdog")
            assert 0.4 - 0.1 <= it.now_s() - stalled_s <= 0.4 + 0.02, "it was fed last within a poll before"
        assert "watchdog" in faults_of(it, head)[0]
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
        with it.host.hanging():
            it.until(lambda: it.servos[0].table["bus_watchdog"] == 255, "the watchdog")
        it.until(lambda: it.servos[0].table["bus_watchdog"] == 20, "the watchdog armed again")
        assert it.settled(head).faults == ()
        assert it.angle_rad(0) == pytest.approx(0.3, abs=COUNT_RAD)
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


@pytest.mark.parametrize("axis", [0, 1])
def test_a_servo_that_is_exchanged_is_refused_when_it_comes_back(axis: int) -> None:
    with opened() as (it, head):
        it.line.hang_up()
        it.servos[axis].table["model_number"] = 1120
        it.servos[axis].model = replace(it.servos[axis].model, number=1120)
        it.line.come_back()
        error = it.until(lambda: isinstance(e := failed(head), WrongDevice) and e, "the refusal")
        assert "XM540-W270" in str(error)


def test_a_hardware_error_stops_the_other_axis_and_blocks_moves() -> None:
    with opened() as (it, head):
        head.move(2.0, 0.9)
        it.until(lambda: head.read().pan_rad > 0.1, "motion")
        it.servos[1].raise_error(OVERLOAD)
        fault = faults_of(it, head)[0]
        assert fault.startswith("tilt (servo 2) reports overload (hardware error 0x20)")
        assert "torque is off" in fault
        assert it.settled(head).pan_rad < 1.9
        with pytest.raises(HardwareFault, match="overload"):
            head.move(0.0, 0.0)
        head.stop()  # must work all the same


def test_a_hardware_error_is_rebooted_away_where_configured() -> None:
    with rig() as it:
        for axis in ("pan", "tilt"):
            it.options[axis]["on_hardware_error"] = "reboot"
        head = it.open()
        it.servos[0].raise_error(HEAT)
        it.until(lambda: failed(head), "the fault")
        it.until(lambda: read_or_none(head), "the head")
        assert head.read().faults == ()
        assert it.servos[0].table["hardware_error_status"] == 0
        assert it.servos[0].table["torque_enable"] == 1
        head.close()


def test_a_supply_that_stays_low_reboots_a_servo_three_times(
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
