"""Exposures stay as they are while an operation runs, and no camera keeps an operation waiting for that."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from drivers.clock import SystemClock
from drivers.errors import DriverError, NoReply, Refused
from drivers.v4l2.camera import HOLD_MOST_S
from hil_tests.mastctl.devices.turned import Hang, Turned
from hil_tests.mastctl.service_fakes import (
    SIZE_PX,
    FakeCamera,
    FakeHardware,
    ScriptedLoop,
    fake_daemon,
    rig,
)
from hil_tests.waiting import NET_S
from mastctl.client import Client
from mastctl.devices.camera_settings import HOLD_TIMEOUT_S
from mastctl.devices.devices import Devices
from mastctl.devices.limits import Limits

LIMITS = Limits((-2.0, 2.0), (-1.0, 1.0), 0.5)


class HoldingCamera(FakeCamera):
    """A camera that can hold its exposure; ``on_hold`` and ``on_release`` may hang or raise."""

    on_hold: Callable[[], Any] = staticmethod(lambda: None)
    on_release: Callable[[], Any] = staticmethod(lambda: None)

    def __init__(self, name: str, seed: int, clock: Turned) -> None:
        super().__init__(name, seed, clock)
        self.told: list[str] = []
        self.threads: set[str] = set()

    @contextmanager
    def exposure_held(self) -> Iterator[None]:
        self.threads.add(threading.current_thread().name)
        self.on_hold()
        self.told.append("held")
        try:
            yield
        finally:
            self.threads.add(threading.current_thread().name)
            self.on_release()
            self.told.append("released")

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Any:
        frame = super().next_frame(exposed_after_s, timeout_s)
        self.told.append("picture")
        return frame


@pytest.fixture
def hardware(clock: Turned) -> FakeHardware:
    made = FakeHardware(clock=clock)
    names = enumerate(made.fake_cameras)
    made.fake_cameras = {name: HoldingCamera(name, seed, clock) for seed, name in names}
    return made


@pytest.fixture
def devices(hardware: FakeHardware, clock: Turned) -> Iterator[Devices]:
    made = Devices(hardware, LIMITS, "0" * 64, clock, rig())
    with clock.at_work():
        yield made
    made.close()


def camera(hardware: FakeHardware, name: str = "navcam_left") -> HoldingCamera:
    found = hardware.fake_cameras[name]
    assert isinstance(found, HoldingCamera)
    return found


def failing(error: BaseException) -> Callable[[], None]:
    def fail() -> None:
        raise error

    return fail


def test_an_exposure_is_held_before_every_picture_of_the_block_and_released_after_it(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    with pytest.raises(ZeroDivisionError), devices.exposure_held():
        devices.frames(["navcam_left"], clock.now_s(), 1.0)
        raise ZeroDivisionError
    left = camera(hardware)
    clock.until(lambda: left.told == ["held", "picture", "released"], "the release")
    assert left.threads == {"device navcam_left"}, "both ends in the camera's own thread"


def test_a_hold_that_waits_for_a_busy_camera_comes_before_the_next_picture(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    hang, left = Hang(clock), camera(hardware)
    left.hook = hang
    asker = clock.begun(lambda: devices.frames(["navcam_left"], clock.now_s(), 5.0))
    hang.reached()
    with devices.exposure_held():
        assert left.told == []
        hang.let_go()
        clock.ended(asker)
        devices.frames(["navcam_left"], clock.now_s(), 1.0)
    clock.until(lambda: left.told == ["picture", "held", "picture", "released"], "the release")


@pytest.mark.parametrize("error", [Refused("no"), ValueError("no"), SystemExit(1), StopIteration()])
def test_a_camera_that_cannot_hold_is_told_and_the_others_hold(
    devices: Devices, hardware: FakeHardware, error: BaseException, clock: Turned
) -> None:
    left, right = camera(hardware), camera(hardware, "navcam_right")
    left.on_hold = failing(error)
    with devices.exposure_held():
        devices.frames(["navcam_left", "navcam_right"], clock.now_s(), 2.0)
    clock.until(lambda: right.told == ["held", "picture", "released"], "the release of the other")
    assert left.told == ["picture"]
    (fault,) = devices.faults()
    assert fault.device == "navcam_left" and fault.until == "an operation can hold the exposure again"
    left.on_hold = lambda: None
    with devices.exposure_held():
        pass
    clock.until(lambda: left.told == ["picture", "held", "released"], "a hold that goes well")
    assert devices.faults() == ()


def test_a_release_that_fails_keeps_no_other_camera_held(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    for name, each in hardware.fake_cameras.items():
        assert isinstance(each, HoldingCamera)
        if name != "hazcam_left":
            each.on_release = failing(RuntimeError("no"))
    with devices.exposure_held():
        pass
    clock.until(lambda: camera(hardware, "hazcam_left").told == ["held", "released"], "the release")
    clock.until(lambda: len(devices.faults()) == 2, "both faults")


def test_a_camera_that_hangs_while_it_is_told_to_hold_keeps_nobody_waiting_and_is_released_when_it_is_back(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    hang, left = Hang(clock), camera(hardware)
    left.on_hold = hang
    with devices.exposure_held():
        hang.reached()
        devices.move(0.1, 0.1)
        devices.frames(["navcam_right"], clock.now_s(), 1.0)
    clock.until(lambda: camera(hardware, "navcam_right").told[-1] == "released", "the release of the other")
    clock.until(lambda: any("hold_exposure" in f.message for f in devices.faults()), "the fault")
    for _ in range(3):  # the next operations find it hanging; none queues up
        with devices.exposure_held(), pytest.raises(NoReply, match="hold_exposure has been under way"):
            devices.frames(["navcam_left"], clock.now_s(), 1.0)
    assert left.told == []
    left.on_hold = lambda: None
    hang.let_go()
    clock.until(lambda: left.told == ["held", "released"], "the late hold's release")
    assert devices.frames(["navcam_left"], clock.now_s(), 1.0)
    assert devices.faults() == ()


def test_a_hold_that_waits_as_long_as_a_driver_may_is_not_said_to_hang() -> None:
    """At 8 frames/s and fewer a V4L2 camera waits a second for settings, and one for its automatic."""
    assert HOLD_TIMEOUT_S > 2 * HOLD_MOST_S


def test_a_release_that_hangs_is_a_fault_of_that_camera_alone(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    hang, left = Hang(clock), camera(hardware)
    left.on_release = hang
    with devices.exposure_held():
        pass
    hang.reached()
    clock.until(lambda: any("release_exposure" in f.message for f in devices.faults()), "the fault")
    with devices.exposure_held():
        devices.frames(["navcam_right"], clock.now_s(), 1.0)
    hang.let_go()
    clock.until(lambda: devices.faults() == (), "the camera's return")


def test_joint_angles_are_pointed_at_although_a_camera_hangs_in_its_hold(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    hang = Hang(SystemClock())
    with fake_daemon(monkeypatch, tmp_path) as (daemon, hardware):
        monkeypatch.setattr(ScriptedLoop, "script", staticmethod(ScriptedLoop.good))
        left = hardware.fake_cameras["navcam_left"]

        @contextmanager
        def exposure_held() -> Iterator[None]:
            hang()
            yield

        monkeypatch.setattr(left, "exposure_held", exposure_held, raising=False)
        with Client(daemon.url) as client:
            for _ in range(2):
                operation = client.wait(client.point(pan_rad=0.1, tilt_rad=0.1), timeout_s=NET_S)
                assert operation["state"] == "done"
        hang.reached()
        hang.let_go()


# What else a camera is asked outside a picture


class Asked(FakeCamera):
    """A camera that knows its size and its rhythm, or hangs in being asked for them."""

    on_size: Callable[[], Any] = staticmethod(lambda: None)
    on_times: Callable[[], Any] = staticmethod(lambda: None)
    trigger = ""

    @property
    def size_px(self) -> tuple[int, int]:
        self.on_size()
        return SIZE_PX

    @property
    def period_s(self) -> float:
        self.on_times()
        return 0.05

    def recent_times(self) -> list[Any]:
        return []


def test_a_camera_that_hangs_when_asked_for_its_size_keeps_the_service_from_nothing(
    clock: Turned,
) -> None:
    hardware, hang = FakeHardware(clock=clock), Hang(clock)
    asked = Asked("navcam_left", clock=clock)
    asked.on_size = hang
    hardware.fake_cameras["navcam_left"] = asked
    with clock.at_work():
        devices = Devices(hardware, LIMITS, "0" * 64, clock, rig())
        assert devices.frames(["navcam_right"], clock.now_s(), 1.0)
        assert "size_px has been under way" in devices.faults()[0].message
        hang.let_go()
        clock.until(lambda: devices.faults() == (), "the camera's return")
        assert devices.frames(["navcam_left"], clock.now_s(), 1.0)
    devices.close()


def test_a_camera_that_hangs_when_asked_for_its_times_fails_its_own_pictures_only(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    hang = Hang(clock)
    asked = Asked("navcam_left", clock=clock)
    asked.on_times = hang
    devices._cameras._cameras["navcam_left"] = asked
    begun_s = clock.now_s()
    with pytest.raises(DriverError, match="navcam_left"):
        devices.frames(["navcam_left", "navcam_right"], clock.now_s(), 0.1)
    assert clock.now_s() - begun_s < 5.0
    assert devices.frames(["navcam_right"], clock.now_s(), 1.0)
    hang.let_go()
