"""A driver that hangs in any of its calls: answers within deadlines, and stops that come first and last."""

from __future__ import annotations

import itertools
import logging
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from drivers.clock import SystemClock
from drivers.errors import DriverError, LineLost, NoReply, Refused
from drivers.interfaces import Reading
from hil_tests.mastctl.devices.turned import Hang, Turned
from hil_tests.mastctl.service_fakes import FakeHardware, rig
from hil_tests.waiting import NET_S, until
from mastctl.devices import devices as devices_module
from mastctl.devices.devices import Devices
from mastctl.devices.limits import Limits
from mastctl.devices.stops import room_s
from mastctl.errors import MastctlError, Stopped

LIMITS = Limits((-2.0, 2.0), (-1.0, 1.0), 0.5)
DEADLINE_S = 1.0


@pytest.fixture
def hardware(clock: Turned) -> FakeHardware:
    return FakeHardware(clock=clock)


@pytest.fixture
def devices(hardware: FakeHardware, clock: Turned) -> Iterator[Devices]:
    made = Devices(hardware, LIMITS, "0" * 64, clock, rig())
    with clock.at_work():
        made.read()
        yield made
    hardware.head.hook = lambda name: None
    made.close()


class Hangs:
    """Lets a head hang in the named calls, ``times`` times each; the others pass."""

    def __init__(self, hardware: FakeHardware, *names: str, times: int = 1_000_000) -> None:
        self._names = dict.fromkeys(names, times)
        self.hang = Hang(hardware.head.clock)
        self.entered: list[str] = []
        hardware.head.hook = self

    def __call__(self, name: str) -> None:
        if self._names.get(name, 0) > 0:
            self._names[name] -= 1
            self.entered.append(name)
            self.hang()

    def let_go(self) -> None:
        self._names.clear()
        self.hang.let_go()


def moves(hardware: FakeHardware) -> list[Any]:
    return [call for call in hardware.head.calls if call[0] == "move"]


def one_fault(devices: Devices) -> Any:
    (fault,) = devices.faults()
    return fault


# No move before every stop is back


def test_no_move_goes_out_while_an_old_stop_is_inside_the_driver(
    devices: Devices, hardware: FakeHardware, caplog: pytest.LogCaptureFixture, clock: Turned
) -> None:
    reads, stops = Hang(clock), Hang(clock)
    inside: list[str] = []

    def hang(name: str) -> None:
        if name == "read":
            reads()
        if name == "stop" and not inside:  # the one beside; the one in turn passes
            inside.append(name)
            stops()

    hardware.head.hook = hang
    reads.reached()
    with pytest.raises(NoReply, match="may still move"):
        devices.stop()
    reads.let_go()
    clock.until(lambda: hardware.head.calls == [("stop",)], "the stop in turn")
    devices.read()
    with pytest.raises(
        Stopped, match=r"a stop asked for \d+\.\d s ago has not come back from the driver yet"
    ):
        devices.move(0.5, 0.5)
    clock.until(lambda: "the head may still move" in one_fault(devices).message, "the first one overdue")
    with caplog.at_level(logging.WARNING):
        stops.let_go()
        clock.until(lambda: "ended only now" in one_fault(devices).message, "the late stop told")
    assert "a stop asked for" in caplog.text and "ended only now" in caplog.text
    devices.move(0.5, 0.5)
    assert hardware.head.calls[-1][:3] == ("move", 0.5, 0.5), "no old stop ends the new move"
    clock.until(lambda: devices.faults() == (), "the head at rest after a move")


def test_a_move_that_waits_when_a_stop_hangs_is_never_sent(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    hangs = Hangs(hardware, "read", "stop", times=1)
    hangs.hang.reached()
    refused: list[Exception] = []

    def move() -> None:
        try:
            devices.move(0.5, 0.5)
        except (DriverError, MastctlError) as error:
            refused.append(error)

    movers = clock.begun(move, move, move)
    with pytest.raises(NoReply):
        devices.stop()
    hangs.let_go()
    clock.ended(movers)
    devices.stop()
    assert len(refused) == 3 and moves(hardware) == []


def test_a_late_stop_is_told_until_the_next_one_is_confirmed(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    hangs = Hangs(hardware, "stop")
    with pytest.raises(NoReply, match="may still move"):
        devices.stop()
    clock.sleep(0.1)
    hangs.let_go()
    clock.until(lambda: "ended only now" in one_fault(devices).message, "the late stop's return")
    assert "until" not in one_fault(devices).until and one_fault(devices).until.startswith(
        "a stop is confirmed"
    )
    devices.read()
    assert devices.faults() != ()
    devices.stop()
    assert devices.faults() == ()


# Stops that get through


def test_a_stop_gets_its_own_way_when_an_earlier_one_hangs(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    hangs = Hangs(hardware, "stop", times=1)
    with pytest.raises(NoReply):
        devices.stop()
    devices.stop()
    assert hardware.head.calls == [("stop",)] and hangs.entered == ["stop"]
    hangs.let_go()
    clock.until(lambda: len(hardware.head.calls) >= 2, "the first one's return")


def test_a_stop_without_a_thread_of_its_own_says_so_and_nothing_stays_of_it(
    devices: Devices, hardware: FakeHardware, monkeypatch: pytest.MonkeyPatch, clock: Turned
) -> None:
    def refuse(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    hangs = Hangs(hardware, "stop", times=1)
    with pytest.raises(NoReply):
        devices.stop()
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refuse)
        with pytest.raises(NoReply, match=r"none could be sent beside the call that hangs \(can't start"):
            devices.stop()
    hangs.let_go()
    clock.until(lambda: len(hardware.head.calls) >= 2, "both stops' return")
    devices.stop()
    assert devices.faults() == ()
    devices.move(0.1, 0.1)


def test_a_stop_is_confirmed_by_an_earlier_one_that_comes_back(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    hangs = Hangs(hardware, "stop", times=1)
    done: list[str] = []
    askers = clock.begun(*[lambda: (devices.stop(), done.append("done"))] * 5)
    hangs.hang.reached()
    hangs.let_go()
    clock.ended(askers)
    assert len(done) == 5


def test_a_stop_behind_one_that_was_confirmed_is_overdue_by_its_own_time_only(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    hangs = [Hang(clock), Hang(clock)]
    left = list(hangs)
    hardware.head.hook = lambda name: left.pop(0)() if name == "stop" and left else None
    askers = clock.begun(devices.stop)
    hangs[0].reached()
    askers += clock.begun(devices.stop)
    clock.until(lambda: devices._stops._queued_s is not None, "the second one queued")
    hangs[0].let_go()
    clock.ended(askers)
    hangs[1].reached()
    (inside,) = devices._stops._inside
    waited_s = inside.began_s - inside.asked_s
    assert waited_s > 0.0
    assert devices._stops._overdue(inside.began_s + DEADLINE_S - waited_s / 2) == ""
    assert "has not come back" in devices._stops._overdue(inside.began_s + DEADLINE_S)
    hangs[1].let_go()


def test_stops_repeated_into_a_hanging_driver_pile_up_neither_threads_nor_calls(
    devices: Devices, hardware: FakeHardware, monkeypatch: pytest.MonkeyPatch, clock: Turned
) -> None:
    monkeypatch.setattr(devices_module, "STOP_TIMEOUT_S", 0.06)
    hangs = Hangs(hardware, "read", "stop")
    hangs.hang.reached()
    begun_s = clock.now_s()
    for _ in range(40):
        with pytest.raises(NoReply):
            devices.stop()
    hung_s = clock.now_s() - begun_s
    beside = sum(thread.name == "stop beside" for thread in threading.enumerate())
    most, at_s = 0, begun_s  # as many as the rule allows in the time that it took
    began_s: list[float] = []
    while at_s <= begun_s + hung_s:
        began_s.append(at_s)
        most, at_s = most + 1, room_s(began_s, 0.06)
    assert 1 <= beside <= most < 40
    assert len(devices._head._jobs) <= 1
    hangs.let_go()
    clock.until(lambda: not any(t.name == "stop beside" for t in threading.enumerate()), "all back")
    devices.stop()


def test_an_hour_of_stops_every_tenth_second_keeps_the_threads_few_and_the_waits_short() -> None:
    began_s: list[float] = []
    for tenth in range(36_000):
        now_s = tenth / 10
        if now_s >= room_s(began_s, 1.0):
            began_s.append(now_s)
    assert len(began_s) < 80
    for before_s, after_s in itertools.pairwise(began_s):
        assert after_s - before_s <= max(1.0, before_s / 8) + 0.11
    one_more = room_s(began_s, 1.0)
    assert one_more - began_s[-1] <= 3600 / 8


# Everything that hangs, alone and in pairs


CALLS: dict[str, Callable[[Devices], Any]] = {
    "read": lambda devices: devices.read(),
    "move": lambda devices: devices.move(0.5, 0.5),
    "stop": lambda devices: devices.stop(),
    "report": lambda devices: devices.report(),
}
HANGING = [
    *itertools.combinations(("read", "move", "stop"), 1),
    *itertools.combinations(("read", "move", "stop"), 2),
]


@pytest.mark.parametrize("first", CALLS)
@pytest.mark.parametrize("hanging", HANGING, ids="+".join)
def test_every_call_ends_within_its_deadline_whatever_hangs(
    devices: Devices, hardware: FakeHardware, hanging: tuple[str, ...], first: str, clock: Turned
) -> None:
    hangs = Hangs(hardware, *hanging)
    for name in (first, *CALLS, "move", "stop"):
        begun_s = clock.now_s()
        try:
            CALLS[name](devices)
        except (DriverError, MastctlError) as error:
            assert "\n" not in str(error) and str(error)
        assert clock.now_s() - begun_s <= DEADLINE_S + 1e-6, name
    if "stop" not in hanging:
        assert ("stop",) in hardware.head.calls
    hangs.let_go()
    clock.until(lambda: not any(t.name == "stop beside" for t in threading.enumerate()), "all back")
    devices.stop()
    assert hardware.head.calls[-1] == ("stop",)
    devices.move(0.1, 0.1)
    assert hardware.head.calls[-1][0] == "move"
    clock.until(lambda: devices.faults() == (), "everything well again")


@pytest.mark.parametrize("hanging", HANGING, ids="+".join)
def test_closing_ends_whatever_hangs_and_a_move_that_comes_back_meanwhile_is_stopped(
    monkeypatch: pytest.MonkeyPatch, hanging: tuple[str, ...]
) -> None:
    for name in ("READ_TIMEOUT_S", "MOVE_TIMEOUT_S", "STOP_TIMEOUT_S"):
        monkeypatch.setattr(devices_module, name, 0.3)
    hardware = FakeHardware()  # closing waits for threads in real time
    devices = Devices(hardware, LIMITS, "0" * 64, SystemClock(), rig())
    hangs = Hangs(hardware, *hanging)
    for call in (CALLS["move"], CALLS["read"]):
        try:
            call(devices)
        except DriverError:
            continue
    closing = threading.Thread(target=devices.close)
    closing.start()
    until(lambda: devices._closed, "closing")
    if "move" in hanging:
        hangs.let_go()
    closing.join(NET_S)
    assert not closing.is_alive()
    hangs.let_go()
    if "move" in hanging:
        until(lambda: hardware.head.calls[-1] == ("stop",), "the stop after the late move")
    with pytest.raises((DriverError, Stopped)):
        devices.move(0.1, 0.1)


# Faults that end


def test_a_stop_that_failed_once_is_a_fault_until_a_move_was_taken_and_the_head_rests(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    def fail(name: str) -> None:
        if name == "stop":
            raise Refused("the servo refused")

    hardware.head.hook = fail
    with pytest.raises(Refused, match="the servo refused"):
        devices.stop()
    hardware.head.hook = lambda name: None
    fault = one_fault(devices)
    assert "the servo refused; the head may still move" in fault.message
    assert "a later move is taken and the head then rests" in fault.until
    devices.read()
    assert devices.faults() == (fault,), "a head that rests may be one that nobody had moved"
    hardware.head.moving = True
    devices.move(0.2, 0.1)
    devices.read()
    assert devices.faults() == (fault,)
    hardware.head.moving = False
    clock.until(lambda: devices.faults() == (), "the end of the fault")


def test_a_stop_that_a_lost_line_kept_back_is_a_fault_until_the_head_is_read_at_rest(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    def lose(name: str) -> None:
        raise LineLost("the line hung up")

    hardware.head.moving = True
    devices.read()
    hardware.head.hook = lose
    with pytest.raises(LineLost):
        devices.stop()
    hardware.head.hook = lambda name: None
    devices.read()
    assert "the head may still move" in one_fault(devices).message
    assert one_fault(devices).until == "the line is back and the head rests, or a stop is confirmed"
    hardware.head.moving = False
    clock.until(lambda: devices.faults() == (), "the end of the fault")


def test_a_line_that_is_lost_after_a_refused_stop_does_not_make_rest_the_proof(
    devices: Devices, hardware: FakeHardware
) -> None:
    def fail(name: str) -> None:
        if name == "stop":
            raise Refused("the servo refused")

    def lose(name: str) -> None:
        raise LineLost("the line hung up")

    hardware.head.hook = fail
    with pytest.raises(Refused):
        devices.stop()
    hardware.head.hook = lose
    with pytest.raises(LineLost):
        devices.stop()
    hardware.head.hook = lambda name: None
    for _ in range(3):
        assert not devices.read().moving
    assert one_fault(devices).until == "a stop is confirmed, or a later move is taken and the head then rests"
    devices.stop()
    assert devices.faults() == ()


def test_rest_after_a_move_of_before_the_stop_proves_nothing(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    def fail(name: str) -> None:
        if name == "stop":
            raise Refused("the servo refused")

    hardware.head.moving = True
    devices.move(0.2, 0.1)
    hardware.head.hook = fail
    with pytest.raises(Refused, match="the servo refused"):
        devices.stop()
    fault = one_fault(devices)
    hardware.head.moving = False
    since_s = clock.now_s()
    clock.until(lambda: clock.now_s() > since_s + 2 * devices_module.REST_S and devices.read(), "rest")
    assert devices.faults() == (fault,)
    hardware.head.hook = lambda name: None
    devices.move(0.3, 0.1)
    clock.until(lambda: devices.faults() == (), "the end of the fault")


def test_every_fault_says_what_takes_it_back(devices: Devices, hardware: FakeHardware, clock: Turned) -> None:
    hardware.head.faults = ("tilt motor is hot",)
    devices.read()

    def fail(name: str) -> None:
        raise NoReply("silence")

    hardware.head.hook = fail
    hardware.fake_cameras["navcam_left"].change = lambda frame: None
    for call in (*list(CALLS.values())[:3], lambda d: d.frames(["navcam_left"], clock.now_s(), 1.0)):
        with pytest.raises(DriverError):
            call(devices)
    faults = devices.faults()
    assert len(faults) == 5
    assert all(fault.until for fault in faults), faults


# What else a driver is asked


def test_a_report_that_hangs_or_is_junk_is_a_typed_error_within_a_second(
    hardware: FakeHardware, devices: Devices, clock: Turned
) -> None:
    from drivers.interfaces import Reporting

    hang = Hang(clock)
    answers: list[Any] = [{"pan": "north"}]

    class Counting(Reporting):
        def report(self) -> Any:
            if not answers:
                hang()
                return {}
            return answers.pop()

        def read(self) -> Reading:
            return Reading(0.0, 0.0, False, clock.now_s())

        def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None: ...
        def stop(self) -> None: ...

    devices._pan_tilt = Counting()  # type: ignore[assignment]
    with pytest.raises(DriverError, match="where an AxisReport is expected"):
        devices.report()
    with pytest.raises(NoReply, match="report did not end"):
        devices.report()
    devices.stop()
    hang.let_go()
