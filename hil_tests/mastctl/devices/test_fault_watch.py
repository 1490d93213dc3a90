"""What is wrong with the devices reaches the machine and the listeners when it changes, and once."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from drivers.errors import NoReply
from hil_tests.mastctl.devices.turned import Hang, Turned
from hil_tests.mastctl.service_fakes import FakeHardware, newest, rig
from mastctl.control.machine import StateMachine
from mastctl.devices.cameras import HEAD
from mastctl.devices.devices import Devices
from mastctl.devices.judge import Limits


@pytest.fixture
def machine(clock: Turned) -> StateMachine:
    return StateMachine(clock)


@pytest.fixture
def devices(hardware: FakeHardware, machine: StateMachine, clock: Turned) -> Iterator[Devices]:
    limits = Limits((-2.0, 2.0), (-1.0, 1.0), 0.5)
    made = Devices(hardware.pan_tilt, hardware.cameras, limits, "0" * 64, clock, rig(), machine=machine)
    with clock.at_work():
        clock.until(lambda: machine.standing.state == "ready", "a first reading")
        yield made
    hardware.head.hook = lambda name: None
    made.close()


def test_a_head_that_hangs_is_a_fault_although_nobody_asks(
    devices: Devices, hardware: FakeHardware, machine: StateMachine, clock: Turned
) -> None:
    hang = Hang(clock)
    with machine.publisher.subscribe("fault") as heard:
        hardware.head.hook = lambda name: hang() if name == "read" else None
        clock.until(lambda: machine.standing.state == "fault", "the fault")
        assert "does not answer: read has been under way" in machine.standing.reason
        assert machine.standing.reason.endswith("until the head is read again")
        hardware.head.hook = lambda name: None
        hang.let_go()
        clock.until(lambda: machine.standing.state == "holding", "the end of the fault")
        assert machine.standing.reason.startswith("it is over: ")
        told = heard.wait(0)
        assert {one.key for one in told} == {HEAD} and told[-1].value == () and len(told) <= 4


def test_what_the_head_reports_is_one_fault_as_long_as_it_lasts(
    devices: Devices, hardware: FakeHardware, machine: StateMachine, clock: Turned
) -> None:
    hardware.head.faults = ("tilt motor is hot",)
    clock.until(lambda: machine.standing.state == "fault", "the fault")
    began = machine.standing
    for _ in range(5):
        devices.read()
    (fault,) = devices.faults()
    assert fault == began.faults[0], "since it began, not since the last reading"
    assert machine.standing is began
    hardware.head.faults = ()
    clock.until(lambda: machine.standing.state == "holding", "the end of the fault")


def test_a_stop_that_is_not_confirmed_is_told_before_it_is_over(
    devices: Devices, hardware: FakeHardware, machine: StateMachine
) -> None:
    def refuse(name: str) -> None:
        if name == "stop":
            raise NoReply("no answer", device=HEAD)

    hardware.head.hook = refuse
    machine.stop_requested()
    with pytest.raises(NoReply):
        devices.stop()
    assert machine.standing.state == "stopping" and machine.standing.faults
    machine.stop_ended()
    assert machine.standing.state == "fault" and "may still move" in machine.standing.reason
    hardware.head.hook = lambda name: None
    devices.stop()
    assert machine.standing.state == "holding"


def test_a_fault_of_a_camera_is_published_and_changes_no_state(
    devices: Devices, hardware: FakeHardware, machine: StateMachine, clock: Turned
) -> None:
    def fail() -> None:
        raise NoReply("gone", device="navcam_left")

    with machine.publisher.subscribe("fault", "frame") as heard:
        hardware.fake_cameras["navcam_left"].hook = fail
        with pytest.raises(NoReply):
            devices.frames(["navcam_left"], 0.0, 1.0)
        (told,) = clock.until(lambda: heard.wait(0), "the fault")
        assert (told.topic, told.key) == ("fault", "navcam_left")
        assert [fault.code for fault in told.value] == ["no_reply"]
        hardware.fake_cameras["navcam_left"].hook = lambda: None
        frame = devices.frames(["navcam_left"], 0.0, 1.0)["navcam_left"]
        (facts,) = [one for one in clock.until(lambda: heard.wait(0), "the facts") if one.topic == "frame"]
        assert facts.value.frame_id == frame.frame_id and not hasattr(facts.value, "image")
        clock.until(lambda: newest(machine.publisher, "fault", "navcam_left") == (), "its end")
    assert machine.standing.state == "ready"
