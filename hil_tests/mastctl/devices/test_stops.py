"""A driver that hangs in any of its calls: answers within deadlines, and stops that come first and last."""

from __future__ import annotations

import itertools
import logging
import threading
from collections.abc import Callable
from typing import Any

import pytest

from drivers.clock import SystemClock
from drivers.errors import DriverError, LineLost, NoReply, Refused
from hil_tests.mastctl.devices.turned import LIMITS, Hang, Turned
from hil_tests.mastctl.service_fakes import FakeHardware, rig
from hil_tests.waiting import NET_S, until
from mastctl.devices import devices as devices_module
from mastctl.devices.devices import Devices
from mastctl.devices.thread import REST_S, DeviceThread, next_try_s
from mastctl.errors import MastctlError, Stopped

DEADLINE_S = 1.0


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
        Stopped, match=r"a stop requested \d+\.\d s ago has not come back from the driver yet"
    ):
        devices.move(0.5, 0.5)
    clock.until(lambda: "the head may still move" in one_fault(devices).message, "the first one overdue")
    with caplog.at_level(logging.WARNING):
        stops.let_go()
        clock.until(lambda: "ended only now" in caplog.text, "the late stop logged")
    devices.move(0.5, 0.5)
    assert hardware.head.calls[-1][:3] == ("move", 0.5, 0.5), "no old stop ends the new move"
    clock.until(lambda: devices.faults() == (), "the head at rest after a move")


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


def test_a_stop_is_confirmed_by_an_earlier_one_that_comes_back(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    hangs = Hangs(hardware, "stop", times=1)
    done: list[str] = []

    def stop() -> None:
        devices.stop()
        done.append("done")

    askers = clock.begun(*[stop] * 5)
    hangs.hang.reached()
    assert devices.faults() == (), "no stop is overdue within its time"
    hangs.let_go()
    clock.ended(askers)
    assert len(done) == 5


def test_a_stop_queued_behind_a_confirmed_one_is_waited_for(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    hangs = Hangs(hardware, "read", times=1)
    hangs.hang.reached()
    devices.stop()  # goes out beside the read; its like waits in the head's thread
    assert not devices.stops_returned(0.0)
    returned: list[bool] = []
    waiting = clock.begun(lambda: returned.append(devices.stops_returned(DEADLINE_S)))
    hangs.let_go()
    clock.ended(waiting)
    assert returned == [True] and hardware.head.calls == [("stop",), ("stop",)]


def test_stops_repeated_into_a_hanging_driver_pile_up_no_threads(
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
        most, at_s = most + 1, next_try_s(began_s, 0.06)
    assert 1 <= beside <= most < 40
    hangs.let_go()
    clock.until(lambda: not any(t.name == "stop beside" for t in threading.enumerate()), "all back")
    devices.stop()


# Everything that hangs, alone and in pairs


CALLS: dict[str, Callable[[Devices], Any]] = {
    "read": lambda devices: devices.read(),
    "move": lambda devices: devices.move(0.5, 0.5),
    "stop": lambda devices: devices.stop(),
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
def test_closing_ends_whatever_hangs_and_stops_a_late_move(
    monkeypatch: pytest.MonkeyPatch, hanging: tuple[str, ...]
) -> None:
    for name in ("READ_TIMEOUT_S", "MOVE_TIMEOUT_S", "STOP_TIMEOUT_S"):
        monkeypatch.setattr(devices_module, name, 0.3)
    hardware = FakeHardware()  # closing waits for threads in real time
    devices = Devices(hardware.pan_tilt, hardware.cameras, LIMITS, "0" * 64, SystemClock(), rig())
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


@pytest.mark.parametrize(
    "error", [Refused("the servo refused"), LineLost("the line hung up")], ids=["refused", "lost"]
)
def test_a_failed_stop_is_a_fault_until_the_head_is_read_at_rest(
    devices: Devices, hardware: FakeHardware, clock: Turned, error: DriverError
) -> None:
    def fail(name: str) -> None:
        if name == "stop":
            raise error

    hardware.head.moving = True
    devices.read()
    hardware.head.hook = fail
    with pytest.raises(type(error)):
        devices.stop()
    hardware.head.hook = lambda name: None
    clock.sleep(2 * REST_S)
    devices.read()
    fault = one_fault(devices)
    assert fault.message.endswith(f"{error}; the head may still move")
    assert fault.until == "a stop is confirmed, or the head is read at rest"
    hardware.head.moving = False
    clock.until(lambda: devices.faults() == (), "the end of the fault")


def test_a_head_that_is_read_at_rest_right_after_a_failed_stop_proves_nothing(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    def fail(name: str) -> None:
        if name == "stop":
            raise Refused("the servo refused")

    hardware.head.hook = fail
    with pytest.raises(Refused):
        devices.stop()
    devices.read()
    assert one_fault(devices).code == Refused.code, "it may not have begun to move yet"
    hardware.head.hook = lambda name: None
    devices.stop()
    assert devices.faults() == ()


def test_a_call_given_up_at_its_deadline_is_overdue_for_the_next() -> None:
    clock = Turned()
    hang = Hang(clock)
    with clock.at_work():
        thread = DeviceThread("pan_tilt", clock=clock)
        try:
            with pytest.raises(NoReply, match="did not end within its deadline"):
                thread.call("read", hang, 1.0)
            with pytest.raises(NoReply, match=r"read has been under way for 1\.0 s"):
                thread.call("read", lambda: None, 1.0)
        finally:
            hang.let_go()
    thread.close(60.0)
    assert not any(one.name == "device pan_tilt" for one in threading.enumerate())
