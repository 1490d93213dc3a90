"""A Dynamixel head that is told to stop stands, each axis by itself, whatever the other or the line does.

What is promised in time is seen in the order of the packets, and in where the simulator's axes stand, which
it knows for every moment of the turned clock.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import pytest

from drivers.dynamixel.head import DynamixelHead, Pair
from drivers.dynamixel.link import Link
from drivers.dynamixel.servo import Servo
from drivers.errors import DriverError, LineLost, NoReply
from drivers.servo_bus.bus import Bus
from drivers.servo_bus.head import CLOSE_TIMEOUT_S
from drivers.sim.axis import WireAxis
from drivers.sim.wire.carrier import Reply
from drivers.sim.wire.dynamixel_bus import BROADCAST, Instruction
from drivers.sim.wire.dynamixel_servo import VOLTAGE
from hil_tests.drivers.dynamixel.dynamixel_rig import (
    COUNT_RAD,
    Rig,
    failed,
    opened,
    read_or_none,
    rig,
)
from hil_tests.drivers.turned import Gate, turned
from hil_tests.waiting import NET_S

GOAL_ADDRESS = 116
WRITE, SYNC_WRITE = 3, 0x83
COPIES = 3  # of a brake, each time
ACCELERATION = 15.0
BRAKING_SPARE_RAD = 0.03
"""How much further than a perfect brake an axis may go that was last seen a while ago."""


def goals_in(instruction: Instruction) -> dict[int, int]:
    """The goal position that an instruction carries to each servo."""
    if instruction.code == WRITE:
        return _goal(instruction.packet_id, int.from_bytes(instruction.parameters[:2], "little"),
                     instruction.parameters[2:])  # fmt: skip
    if instruction.code != SYNC_WRITE or instruction.packet_id != BROADCAST:
        return {}
    address, length = (int.from_bytes(instruction.parameters[i : i + 2], "little") for i in (0, 2))
    found: dict[int, int] = {}
    for at in range(4, len(instruction.parameters), length + 1):
        found |= _goal(instruction.parameters[at], address, instruction.parameters[at + 1 : at + 1 + length])
    return found


def _goal(servo_id: int, address: int, data: bytes) -> dict[int, int]:
    at = GOAL_ADDRESS - address
    if not 0 <= at <= len(data) - 4:
        return {}
    return {servo_id: int.from_bytes(data[at : at + 4], "little")}


def goals_after(it: Rig, time_s: float) -> dict[int, list[tuple[float, int]]]:
    """Each servo's goals that went out after a moment, with their times."""
    found: dict[int, list[tuple[float, int]]] = {1: [], 2: []}
    for sent_s, instruction in it.ear.heard:
        if sent_s >= time_s:
            for servo_id, goal in goals_in(instruction).items():
                found[servo_id].append((sent_s, goal))
    return found


def last_words(it: Rig) -> int:
    """The number of the last packet that carried a goal."""
    return max(number for number, (_, one) in enumerate(it.ear.heard) if goals_in(one))


def unpowered(it: Rig, axis: int) -> None:
    it.servos[axis].set_power(False, it.now_s())


def mute(it: Rig, axis: int) -> None:
    it.panel.set("pan_tilt", "mute", sender=axis + 1, replies=1e9)


def garbage(it: Rig, axis: int) -> None:
    it.panel.set("pan_tilt", "corrupt", sender=axis + 1, replies=1e9)


def late(it: Rig, axis: int) -> None:
    it.panel.set("pan_tilt", "late", sender=axis + 1, replies=1e9, delay_s=0.15)


def alert(it: Rig, axis: int) -> None:
    """An error that does not switch the torque off: a servo's shutdown mask leaves the voltage out."""
    it.servos[axis].raise_error(VOLTAGE)


def babble(it: Rig, axis: int) -> None:
    """Noise that never ends."""
    device = it.line.device
    device.poll = lambda time_s: [Reply(b"\xff\xff\xfd\x00\x55", 0.0, axis + 1)]  # type: ignore[method-assign]


FAULTS: list[Callable[[Rig, int], None]] = [unpowered, mute, garbage, late, alert, babble]


def reachable(it: Rig) -> list[int]:
    return [number for number, servo in enumerate(it.servos) if servo.powered]


def assert_each_stands_where_it_brakes(it: Rig, told_s: float) -> None:
    """Every axis with power was told to brake first of all, and came to rest as quickly as it can."""
    goals = goals_after(it, told_s)
    for number in reachable(it):
        axis = it.axes[number]
        first_s, first_goal = goals[number + 1][0]
        before = [i for s, i in it.ear.heard if told_s < s < first_s and not goals_in(i)]
        assert len(before) <= 1, f"{before} went out between the call and the brake of servo {number + 1}"
        rested(it, axis)
        at_rad, speed = axis.angle_rad(first_s), abs(axis.velocity_rad_per_s(first_s))
        way_rad = abs(axis.angle_rad(it.now_s()) - at_rad)
        assert way_rad <= speed**2 / (2 * ACCELERATION) + BRAKING_SPARE_RAD, f"servo {number + 1}"
        for _, goal in goals[number + 1]:
            assert abs(goal - first_goal) * COUNT_RAD <= BRAKING_SPARE_RAD, f"servo {number + 1}: {goals}"


def rested(it: Rig, axis: WireAxis) -> None:
    it.until(lambda: axis.velocity_rad_per_s(it.now_s()) == 0, "rest")


def under_way(it: Rig, head: DynamixelHead, goal: tuple[float, float] = (2.0, 0.9)) -> None:
    head.move(*goal)
    it.until(lambda: all(abs(axis.angle_rad(it.now_s())) > 0.15 for axis in it.axes), "motion")


@pytest.mark.parametrize("axis", [0, 1], ids=["pan", "tilt"])
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
@pytest.mark.parametrize("unnoticed", [True, False], ids=["at_once", "while_it_is_missed"])
def test_a_stop_brakes_each_axis_at_once_whatever_the_other_does(
    fault: Callable[[Rig, int], None], axis: int, unnoticed: bool
) -> None:
    with opened(options={"acceleration_rad_per_s2": ACCELERATION}) as (it, head):
        under_way(it, head)
        fault(it, axis)
        told_s = it.now_s()
        if not unnoticed:
            heard = len(it.ear.heard)
            it.until(lambda: len(it.ear.heard) >= heard + 2, "a question that is answered wrongly")
            now_s = it.now_s()
            # if that was the end of the line already, the axes were told to brake when it was given up
            told_s = told_s if any(goals_after(it, told_s).values()) else now_s
        with suppress(DriverError):
            head.stop()
        assert_each_stands_where_it_brakes(it, told_s)


@pytest.mark.parametrize("fault", [unpowered, mute, late], ids=lambda fault: fault.__name__)
def test_after_an_unconfirmed_stop_nothing_feeds_a_watchdog(
    fault: Callable[[Rig, int], None],
) -> None:
    with opened() as (it, head):
        under_way(it, head)
        fault(it, 0)
        told_s = it.now_s()
        with pytest.raises(DriverError, match=r"pan .servo 1. did not confirm the stop and may still move"):
            head.stop()
        it.until(lambda: len(goals_after(it, told_s)[2]) == 2 * COPIES, "the last words")

        def more() -> list[Instruction]:
            return [one for _, one in it.ear.heard[last_words(it) + 1 :]]

        while not more():  # a user who hits the button again and again
            with pytest.raises(DriverError):
                head.stop()
            it.clock.sleep(0.005)
        assert it.servos[1].table["bus_watchdog"] == 255, "something was said before the watchdog had tripped"
        assert not it.axes[1].under_way(it.now_s())


@pytest.mark.parametrize("fault", [unpowered, garbage, alert], ids=lambda fault: fault.__name__)
def test_no_second_leg_goes_out_after_a_stop(fault: Callable[[Rig, int], None]) -> None:
    with rig() as it:
        for axis in ("pan", "tilt"):
            it.options[axis].update(approach="positive", approach_rad=0.05)
        head = it.open(acceleration_rad_per_s2=ACCELERATION)
        under_way(it, head, (-2.0, -0.9))
        fault(it, 0)
        told_s = it.now_s()
        with suppress(DriverError):
            head.stop()
        assert_each_stands_where_it_brakes(it, told_s)
        it.until(lambda: read_or_none(head) or failed(head), "an answer")
        assert_each_stands_where_it_brakes(it, told_s)
        head.close()


def test_repeated_stops_do_not_let_a_drooping_axis_creep() -> None:
    with opened() as (it, head):
        head.move(0.5, 0.3)
        it.settled(head)
        goal = it.servos[1].table["goal_position"]
        it.panel.set("pan_tilt", "wrong", axis=1, offset_rad=-2 * COUNT_RAD)
        for _ in range(5):
            head.stop()
        assert it.servos[1].table["goal_position"] == goal


def test_a_stop_clears_a_trip_that_nobody_has_noticed_yet_without_moving() -> None:
    with opened() as (it, head):
        under_way(it, head)
        for servo in it.servos:
            with it.line.device.held():  # type: ignore[attr-defined]
                servo.table["bus_watchdog"] = 255
                servo.drive.stop(it.now_s())
        head.stop()
        assert [servo.table["bus_watchdog"] for servo in it.servos] == [20, 20]
        stood = [axis.angle_rad(it.now_s()) for axis in it.axes]
        assert it.settled(head).faults == ()
        assert [axis.angle_rad(it.now_s()) for axis in it.axes] == pytest.approx(stood, abs=2 * COUNT_RAD)


@pytest.mark.parametrize("silent", [0, 1], ids=["pan", "tilt"])
def test_closing_beside_a_silent_servo_leaves_the_other_as_configured(silent: int) -> None:
    with rig() as it:
        for axis in ("pan", "tilt"):
            it.options[axis]["at_close"] = "torque_off"
        head = it.open()
        under_way(it, head)
        mute(it, silent)
        closing_s = it.now_s()
        head.close()
        assert it.servos[1 - silent].table["torque_enable"] == 0
        assert it.servos[1 - silent].table["bus_watchdog"] == 0
        assert it.servos[silent].table["torque_enable"] == 1, "it may still move"
        assert it.servos[silent].table["bus_watchdog"] != 0  # nobody knows what it does: that stops it
        assert goals_after(it, closing_s)[silent + 1], "the silent one was not told to brake"


@pytest.mark.parametrize("reply_timeout_s", [0.05, 0.3])
@pytest.mark.parametrize("bad", [(1,), (0, 1)], ids=["tilt", "both"])
@pytest.mark.parametrize("fault", [mute, garbage, late, babble])
def test_a_closing_ends_in_its_time_beside_an_axis_that_never_stands(
    fault: Callable[[Rig, int], None],
    bad: Sequence[int],
    reply_timeout_s: float,
    caplog: pytest.LogCaptureFixture,
) -> None:
    with rig() as it:
        it.options["pan"]["at_close"] = it.options["tilt"]["at_close"] = "torque_off"
        head = it.open(watchdog_s=0, reply_timeout_s=reply_timeout_s)
        under_way(it, head)
        for axis in bad:
            fault(it, axis)
        it.axes[0].goal(it.now_s(), 1e4, 0.2, 10.0)
        it.axes[0]._take = lambda *_: None  # type: ignore[method-assign]
        closing_s = it.now_s()
        head.close()
        assert it.now_s() - closing_s < CLOSE_TIMEOUT_S and "left behind" not in caplog.text
        assert it.servos[0].table["torque_enable"] == 1 and it.speed_rad_per_s(0) > 0.1
        assert "may still move" in caplog.text or "did not come to rest" in caplog.text


@pytest.mark.parametrize("watchdog_s", [0, 0.4])
def test_a_closing_during_which_the_power_goes_ends_in_its_time(
    watchdog_s: float, caplog: pytest.LogCaptureFixture
) -> None:
    with rig() as it:
        it.options["pan"]["at_close"] = it.options["tilt"]["at_close"] = "torque_off"
        head = it.open(watchdog_s=watchdog_s)
        under_way(it, head)
        closing = it.beside(head.close)
        closing_s = it.now_s()
        it.until(lambda: it.now_s() > closing_s + 0.2, "the axes brake")
        for axis in (0, 1):
            unpowered(it, axis)
        closing.wait()
        assert it.now_s() - closing_s < CLOSE_TIMEOUT_S and "left behind" not in caplog.text


def test_a_move_that_waits_when_a_stop_comes_is_not_begun() -> None:
    with turned() as it:
        bus = Bus("test", lambda: it.now_s() + 60.0, it.clock)
        bus.start()
        free = it.gate()
        done: list[str] = []
        errors: list[DriverError] = []

        def call(what: str, **how: Any) -> Gate:
            def run() -> None:
                try:
                    bus.call(what, lambda: done.append(what), NET_S, **how)
                except DriverError as error:
                    errors.append(error)

            return it.beside(run)

        busy = it.gate()

        def keep() -> None:
            busy.set()
            free.wait()

        hold = it.beside(lambda: bus.call("hold", keep, NET_S))
        busy.wait()
        move, read = call("move", moves=True), call("read")
        it.clock.sleep(0.001)  # both wait
        stop = call("stop", first=True)
        it.until(bus.urgent, "the stop to wait")
        late_move = call("a later move", moves=True)
        it.clock.sleep(0.001)  # it waits too
        free.set()
        for ended in (hold, move, read, stop, late_move):
            ended.wait()
        assert done == ["stop", "read", "a later move"]
        assert isinstance(errors[0], NoReply)
        assert str(errors[0]) == "move on test was not begun; nothing was sent, since a stop came"
        bus.close(lambda: None, NET_S)


@pytest.mark.parametrize("silent", [None, 0, 1], ids=["none", "pan", "tilt"])
def test_without_a_watchdog_a_stop_tries_a_line_that_is_away_at_once(
    silent: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.absent.FIRST_WAIT_S", NET_S)  # not before a call asks for it
    with opened(options={"watchdog_s": 0}) as (it, head):
        head.move(2.4, 0.9, 0.2)
        it.until(lambda: all(axis.angle_rad(it.now_s()) > 0.05 for axis in it.axes), "motion")
        it.line.hang_up()
        it.until(lambda: isinstance(failed(head), LineLost), "the line to be given up")
        with pytest.raises(LineLost):
            head.stop()
        if silent is not None:
            unpowered(it, silent)
        it.line.come_back()
        back_s = it.now_s()
        if silent is None:
            head.stop()
        else:
            with pytest.raises(NoReply):
                head.stop()
        for axis in (it.axes[number] for number in reachable(it)):
            rested(it, axis)
            assert axis.angle_rad(it.now_s()) - axis.angle_rad(back_s) < 0.4, "it ran on to its goal"
        if silent is None:
            it.until(lambda: not failed(head), "an answer")
            assert it.settled(head).faults == ()


@pytest.mark.parametrize("register", ["min_position_limit", "goal_position"])
@pytest.mark.parametrize("overtaking", ["close", "stop"])
def test_an_axis_let_go_for_its_set_up_holds_when_it_is_broken_off(
    register: str, overtaking: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = {"torque_off_at_start": True, "watchdog_s": 0}
    with opened(options=options) as (it, head):
        it.line.hang_up()
        it.until(lambda: isinstance(failed(head), LineLost), "the line to be given up")
        table = it.servos[1].table
        table["min_position_limit"] += 1  # somebody else has set it, so that it must be set up anew
        limp, true_set = it.gate(), Servo.set

        def set_late(servo: Servo, name: str, value: int) -> None:
            if name == register and not table["torque_enable"] and not limp.is_open:
                limp.set()
                it.clock.sleep(0.005)  # the test's call overtakes it
            true_set(servo, name, value)

        monkeypatch.setattr(Servo, "set", set_late)
        broken_off: list[int] = []
        true_close = Link.close

        def close(link: Link) -> None:
            broken_off.append(table["torque_enable"])
            true_close(link)

        monkeypatch.setattr(Link, "close", close)
        it.line.come_back()
        limp.wait()
        getattr(head, overtaking)()
        assert set(broken_off) == {1}
        assert table["torque_enable"] == 1


def test_a_failed_move_whose_goals_went_out_brakes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with opened() as (it, head):
        true_send = Pair.send_goals

        def send(pair: Pair, speeds: Sequence[int]) -> Sequence[int]:
            sent = true_send(pair, speeds)
            mute(it, 0)
            return sent

        monkeypatch.setattr(Pair, "send_goals", send)
        with pytest.raises(NoReply):
            head.move(2.0, 0.9)
        it.panel.clear()
        it.until(lambda: all(not axis.under_way(it.now_s()) for axis in it.axes), "rest")
        assert it.angle_rad(0) < 1.5
        assert it.angle_rad(1) < 0.8
