"""A Dynamixel head that is told to stop stands, each axis by itself, whatever the other or the line does.

What is promised in time is seen in the order of the packets, and in where the simulator's axes stand, which
it knows for every moment of the turned clock.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import pytest

from drivers.absent import FIRST_WAIT_S
from drivers.dynamixel.head import DynamixelHead
from drivers.dynamixel.link import Link
from drivers.dynamixel.pair import Pair
from drivers.dynamixel.servo import Servo
from drivers.errors import DriverError, LineLost, NoReply, WrongDevice
from drivers.servo_bus.bus import Bus
from drivers.servo_bus.head import CLOSE_TIMEOUT_S
from drivers.servo_bus.port import Overtaken
from drivers.servo_bus.session import GivenUp, ServoSession
from drivers.sim.wire.carrier import Reply
from drivers.sim.wire.dynamixel_packets import BROADCAST, Instruction
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
        it.until(lambda a=axis: a.velocity_rad_per_s(it.now_s()) == 0, "rest")
        at_rad, speed = axis.angle_rad(first_s), abs(axis.velocity_rad_per_s(first_s))
        way_rad = abs(axis.angle_rad(it.now_s()) - at_rad)
        assert way_rad <= speed**2 / (2 * ACCELERATION) + BRAKING_SPARE_RAD, f"servo {number + 1}"
        for _, goal in goals[number + 1]:
            assert abs(goal - first_goal) * COUNT_RAD <= BRAKING_SPARE_RAD, f"servo {number + 1}: {goals}"


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
def test_after_a_stop_that_was_not_confirmed_nothing_feeds_a_watchdog(
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


@pytest.mark.parametrize("silent", [0, 1], ids=["pan", "tilt"])
def test_a_stop_given_again_and_again_does_not_keep_the_other_axis_running(silent: int) -> None:
    options = {"acceleration_rad_per_s2": 5.0, "watchdog_s": 0.28, "reply_timeout_s": 0.05}
    with opened(options=options) as (it, head):
        head.move(2.4, 0.95)
        it.until(lambda: all(axis.angle_rad(it.now_s()) > 0.1 for axis in it.axes), "motion")
        unpowered(it, silent)
        told_s = it.now_s()
        for _ in range(15):
            with suppress(DriverError):
                head.stop()
            it.clock.sleep(0.1)
        axis = it.axes[1 - silent]
        it.until(lambda: axis.velocity_rad_per_s(it.now_s()) == 0, "rest")
        first_s = goals_after(it, told_s)[2 - silent][0][0]
        way_rad = axis.angle_rad(it.now_s()) - axis.angle_rad(first_s)
        assert way_rad <= 1.0**2 / (2 * 5.0) + BRAKING_SPARE_RAD
        assert axis.velocity_rad_per_s(first_s + 0.5) == 0


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


def test_a_head_whose_line_is_given_up_is_told_to_brake_first() -> None:
    with opened(options={"acceleration_rad_per_s2": ACCELERATION}) as (it, head):
        under_way(it, head)
        sent_s = it.now_s()
        unpowered(it, 0)
        it.until(lambda: head._absence.error, "giving up")
        stands = goals_after(it, sent_s)[2]
        assert stands, "the line was given up with the tilt under way"
        axis = it.axes[1]
        it.until(lambda: axis.velocity_rad_per_s(it.now_s()) == 0, "rest")
        way_rad = axis.angle_rad(it.now_s()) - axis.angle_rad(stands[0][0])
        assert way_rad <= 1.0 / (2 * ACCELERATION) + BRAKING_SPARE_RAD


def test_a_servo_with_an_error_that_leaves_its_torque_on_brakes_too() -> None:
    with opened() as (it, head):
        under_way(it, head)
        alert(it, 0)
        it.until(lambda: head.read().faults, "the fault")
        reading = it.settled(head)
        assert reading.pan_rad < 1.8
        assert reading.tilt_rad < 0.85
        assert it.servos[0].table["torque_enable"] == 1


def test_stopping_an_axis_that_droops_again_and_again_does_not_let_it_creep() -> None:
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


@pytest.mark.parametrize("fault", [unpowered, mute], ids=lambda fault: fault.__name__)
def test_a_tripped_tilt_beside_a_silent_pan_stays_where_it_is(fault: Callable[[Rig, int], None]) -> None:
    with opened() as (it, head):
        under_way(it, head)
        with it.line.device.held():  # type: ignore[attr-defined]
            it.servos[1].table["bus_watchdog"] = 255
            it.servos[1].drive.stop(it.now_s())
        fault(it, 0)
        with pytest.raises(DriverError, match="pan"):
            head.stop()
        axis = it.axes[1]
        it.until(lambda: axis.velocity_rad_per_s(it.now_s()) == 0, "rest")
        stood_rad = axis.angle_rad(it.now_s())
        heard = len(it.ear.heard)
        it.until(lambda: len(it.ear.heard) > heard + 3, "some tries to come back")
        assert axis.angle_rad(it.now_s()) == pytest.approx(stood_rad, abs=2 * COUNT_RAD)


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
        assert it.servos[silent].table["bus_watchdog"] != 0  # nobody knows what it does: that stops it
        assert goals_after(it, closing_s)[silent + 1], "the silent one was not told to brake"


def test_closing_keeps_the_torque_of_a_servo_that_does_not_say_whether_it_stands(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with rig() as it:
        it.options["pan"]["at_close"] = it.options["tilt"]["at_close"] = "torque_off"
        head = it.open()
        under_way(it, head)
        true_look = Servo.look

        def look(servo: Servo) -> Any:
            if servo.name.startswith("pan"):
                raise NoReply("its answer is garbled")
            return true_look(servo)

        monkeypatch.setattr(Servo, "look", look)
        head.close()
        assert [servo.table["torque_enable"] for servo in it.servos] == [1, 0]


@pytest.mark.parametrize("reply_timeout_s", [0.05, 0.1, 0.3])
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
        it.axes[0].velocity(it.now_s(), 0.2, 10.0)
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


@pytest.mark.parametrize("reply_timeout_s", [0.05, 0.3])
def test_a_closing_whose_line_goes_and_is_slow_to_fail_ends_in_its_time(
    reply_timeout_s: float, caplog: pytest.LogCaptureFixture
) -> None:
    with rig() as it:
        head = it.open(watchdog_s=0, reply_timeout_s=reply_timeout_s)
        under_way(it, head)
        for axis in (0, 1):
            mute(it, axis)

        opened_s: list[float] = []

        def away(*_: Any) -> Any:
            opened_s.append(it.now_s())
            it.clock.sleep(0.5)  # as a network's line whose host is away
            raise LineLost("no route to it")

        head._open_line = away
        closing_s = it.now_s()
        head.close()
        assert it.now_s() - closing_s < CLOSE_TIMEOUT_S and "left behind" not in caplog.text
        assert "may still move" in caplog.text and opened_s
        head._bus._closing_until_s = it.now_s() - 0.1
        tries = len(opened_s)
        with pytest.raises(Overtaken):
            head._stop_away(it.now_s())
        assert len(opened_s) == tries, "no line is opened when the time is over"


def test_a_stop_owed_at_a_return_is_owed_again_if_it_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    with opened(options={"watchdog_s": 0}) as (it, head):
        it.line.hang_up()
        it.until(lambda: failed(head) and head._session is None, "the line to be given up")
        head._stop_owed = True
        tries: list[float] = []
        true_stop = ServoSession.stop

        def stop(session: ServoSession) -> None:
            tries.append(it.now_s())
            if len(tries) == 1:
                raise GivenUp(NoReply("no confirmation"))
            true_stop(session)

        monkeypatch.setattr(ServoSession, "stop", stop)
        it.line.come_back()
        it.until(lambda: not failed(head), "an answer")
        assert len(tries) == 2 and not head._stop_owed
        assert tries[1] - tries[0] > 2 * FIRST_WAIT_S, "the waits grow"
        head._stop_owed = True
        head.move(0.2, 0.1)
        assert not head._stop_owed, "who moves the head wants no former stop"


def test_a_stop_breaks_off_what_is_under_way_and_its_caller_is_told() -> None:
    with opened(options={"reply_timeout_s": 0.3}) as (it, head):
        under_way(it, head)
        mute(it, 0)
        errors: list[BaseException] = []

        def read() -> None:
            for _ in range(50):
                try:
                    head.read()
                except DriverError as error:
                    errors.append(error)
                    return

        reader = it.beside(read)
        heard = len(it.ear.heard)
        it.until(lambda: len(it.ear.heard) > heard + 1, "a question without an answer")
        told_s = it.now_s()
        with suppress(DriverError):
            head.stop()
        reader.wait()
        assert errors, "the read did not end"
        assert_each_stands_where_it_brakes(it, told_s)


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
        it.until(lambda: len(bus._jobs) == 2, "both to wait")
        stop = call("stop", first=True)
        it.until(bus.urgent, "the stop to wait")
        late_move = call("a later move", moves=True)
        it.until(lambda: len(bus._jobs) == 3, "the later move to wait")
        free.set()
        for ended in (hold, move, read, stop, late_move):
            ended.wait()
        assert done == ["stop", "read", "a later move"]
        assert isinstance(errors[0], NoReply)
        assert str(errors[0]) == "move on test was not begun; nothing was sent, since a stop came"
        bus.close(lambda: None, NET_S)


def test_a_queued_move_does_not_move_the_head_after_the_stop_that_overtook_it() -> None:
    with opened() as (it, head):
        free, busy = it.gate(), it.gate()

        def stall() -> None:
            busy.set()
            free.wait()

        stalled = it.beside(lambda: head._bus.call("stall", stall, NET_S))
        busy.wait()
        errors: list[DriverError] = []

        def move() -> None:
            try:
                head.move(2.0, 0.9)
            except DriverError as error:
                errors.append(error)

        mover = it.beside(move)
        it.until(lambda: head._bus._jobs, "the move to wait")
        stopper = it.beside(head.stop)
        it.until(head._bus.urgent, "the stop to wait")
        free.set()
        for ended in (stalled, mover, stopper):
            ended.wait()
        assert "since a stop came" in str(errors[0])
        assert it.settled(head).pan_rad == pytest.approx(0.0, abs=COUNT_RAD)
        assert it.servos[0].table["goal_position"] == 2048


@pytest.mark.parametrize("held", [0, 1], ids=["pan", "tilt"])
def test_a_stop_that_breaks_off_a_taking_hold_leaves_no_torque_on_where_it_lets_go(held: int) -> None:
    with rig() as it:
        for axis in ("pan", "tilt"):
            it.options[axis]["at_stop"] = "torque_off"
        head = it.open()
        head.stop()
        it.until(lambda: not any(servo.table["torque_enable"] for servo in it.servos), "no torque")
        mover = it.beside(lambda: failed_move(head))
        it.until(lambda: it.servos[held].table["torque_enable"], "torque")
        head.stop()
        mover.wait()
        it.until(lambda: not any(servo.table["torque_enable"] for servo in it.servos), "no torque")
        head.close()


def failed_move(head: DynamixelHead) -> None:
    with suppress(DriverError):
        head.move(0.5, 0.3)


@pytest.mark.parametrize("silent", [None, 0, 1], ids=["none", "pan", "tilt"])
def test_without_a_watchdog_a_stop_tries_a_line_that_is_away_at_once(silent: int | None) -> None:
    with opened(options={"watchdog_s": 0}) as (it, head):
        head.move(2.4, 0.9, 0.2)
        it.until(lambda: all(axis.angle_rad(it.now_s()) > 0.05 for axis in it.axes), "motion")
        it.line.hang_up()
        it.until(lambda: failed(head) and head._session is None, "the line to be given up")
        with pytest.raises(LineLost):
            head.stop()
        head._absence.again_s = it.now_s() + NET_S  # not before somebody asks for it
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
            it.until(lambda a=axis: a.velocity_rad_per_s(it.now_s()) == 0, "rest")
            assert axis.angle_rad(it.now_s()) - axis.angle_rad(back_s) < 0.4, "it ran on to its goal"
        if silent is None:
            it.until(lambda: not failed(head), "an answer")
            assert it.settled(head).faults == ()


@pytest.mark.parametrize("register", ["min_position_limit", "goal_position"])
@pytest.mark.parametrize("overtaking", ["close", "stop"])
def test_an_axis_whose_torque_was_dropped_to_set_it_up_holds_again_when_that_is_broken_off(
    register: str, overtaking: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = {"torque_off_at_start": True, "watchdog_s": 0}
    with opened(options=options) as (it, head):
        it.line.hang_up()
        it.until(lambda: failed(head) and head._session is None, "the line to be given up")
        table = it.servos[1].table
        table["min_position_limit"] += 1  # somebody else has set it, so that it must be set up anew
        limp, true_set = it.gate(), Servo.set

        def set_late(servo: Servo, name: str, value: int) -> None:
            if name == register and not table["torque_enable"] and not limp.is_open:
                limp.set()
                it.until(head._bus.urgent, "who overtakes it")
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


def test_an_axis_that_droops_beyond_its_limit_holds_again_too(monkeypatch: pytest.MonkeyPatch) -> None:
    with opened(options={"torque_off_at_start": True, "watchdog_s": 0}) as (it, head):
        it.line.hang_up()
        it.until(lambda: failed(head) and head._session is None, "the line to be given up")
        servo, true_set = it.servos[1], Servo.set
        servo.table["return_delay_time"] = 250  # somebody else has set it
        low = head.settings.tilt.limit_counts[0]

        def fails(one: Servo, name: str, value: int) -> None:
            if name == "return_delay":
                it.axes[1].to_count(it.now_s(), (low - 2 - 2048) * COUNT_RAD, 50.0)
                it.until(lambda: not it.axes[1].under_way(it.now_s()), "it droops")
                raise WrongDevice("no")
            true_set(one, name, value)

        monkeypatch.setattr(Servo, "set", fails)
        it.line.come_back()
        it.until(lambda: isinstance(failed(head), WrongDevice), "the refusal")
        assert servo.table["torque_enable"] == 1


def test_a_move_whose_goals_went_out_but_that_is_told_as_failed_brakes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with opened() as (it, head):
        true_send = Pair.send

        def send(pair: Pair, values: Any) -> None:
            true_send(pair, values)
            mute(it, 0)

        monkeypatch.setattr(Pair, "send", send)
        with pytest.raises(NoReply):
            head.move(2.0, 0.9)
        it.panel.clear()
        it.until(lambda: all(not axis.under_way(it.now_s()) for axis in it.axes), "rest")
        assert it.angle_rad(0) < 1.5
        assert it.angle_rad(1) < 0.8
