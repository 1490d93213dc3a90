"""Exposures stay as they are while an operation runs, and no camera keeps an operation waiting for that."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from drivers.clock import SystemClock
from drivers.errors import DriverError, NoReply, Refused
from hil_tests.mastctl.service_fakes import (
    SIZE_PX,
    FakeCamera,
    FakeHardware,
    Hang,
    ScriptedLoop,
    eventually,
    fake_daemon,
    rig,
)
from mastctl.client import Client
from mastctl.devices import cameras as cameras_module
from mastctl.devices import exposure_hold as exposure_hold_module
from mastctl.devices.devices import Devices
from mastctl.devices.limits import Limits

DEADLINE_S = 0.3


class HoldingCamera(FakeCamera):
    """A camera that can hold its exposure; ``on_hold`` and ``on_release`` may hang or raise."""

    on_hold: Callable[[], Any] = staticmethod(lambda: None)
    on_release: Callable[[], Any] = staticmethod(lambda: None)

    def __init__(self, name: str, seed: int = 0) -> None:
        super().__init__(name, seed)
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
def hardware() -> FakeHardware:
    made = FakeHardware()
    made.fake_cameras = {name: HoldingCamera(name, seed) for seed, name in enumerate(made.fake_cameras)}
    return made


@pytest.fixture
def devices(hardware: FakeHardware, monkeypatch: pytest.MonkeyPatch) -> Iterator[Devices]:
    monkeypatch.setattr(cameras_module, "CAMERA_GRACE_S", DEADLINE_S)
    monkeypatch.setattr(exposure_hold_module, "HOLD_TIMEOUT_S", DEADLINE_S, raising=False)
    made = Devices(hardware, Limits((-2.0, 2.0), (-1.0, 1.0), 0.5), "0" * 64, SystemClock(), rig())
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
    devices: Devices, hardware: FakeHardware
) -> None:
    with pytest.raises(ZeroDivisionError), devices.exposure_held():
        devices.frames(["navcam_left"], time.monotonic(), 1.0)
        raise ZeroDivisionError
    left = camera(hardware)
    eventually(lambda: left.told == ["held", "picture", "released"], "the release")
    assert left.threads == {"device navcam_left"}, "both ends in the camera's own thread"


def test_a_hold_that_waits_for_a_busy_camera_comes_before_the_next_picture(
    devices: Devices, hardware: FakeHardware
) -> None:
    hang, left = Hang(), camera(hardware)
    left.hook = hang
    asker = threading.Thread(target=lambda: devices.frames(["navcam_left"], time.monotonic(), 5.0))
    asker.start()
    assert hang.entered.wait(5.0)
    with devices.exposure_held():
        assert left.told == []
        hang.let_go()
        asker.join(5.0)
        devices.frames(["navcam_left"], time.monotonic(), 1.0)
    eventually(lambda: left.told == ["picture", "held", "picture", "released"], "the release")


@pytest.mark.parametrize("error", [Refused("no"), ValueError("no"), SystemExit(1), StopIteration()])
def test_a_camera_that_cannot_hold_is_told_and_the_others_hold(
    devices: Devices, hardware: FakeHardware, error: BaseException
) -> None:
    left, right = camera(hardware), camera(hardware, "navcam_right")
    left.on_hold = failing(error)
    with devices.exposure_held():
        devices.frames(["navcam_left", "navcam_right"], time.monotonic(), 2.0)
    eventually(lambda: right.told == ["held", "picture", "released"], "the release of the other")
    assert left.told == ["picture"]
    (fault,) = devices.faults()
    assert fault.device == "navcam_left" and fault.until == "an operation can hold the exposure again"
    left.on_hold = lambda: None
    with devices.exposure_held():
        pass
    eventually(lambda: left.told == ["picture", "held", "released"], "a hold that goes well")
    assert devices.faults() == ()


def test_a_release_that_fails_keeps_no_other_camera_held(devices: Devices, hardware: FakeHardware) -> None:
    for name, each in hardware.fake_cameras.items():
        assert isinstance(each, HoldingCamera)
        if name != "hazcam_left":
            each.on_release = failing(RuntimeError("no"))
    with devices.exposure_held():
        pass
    eventually(lambda: camera(hardware, "hazcam_left").told == ["held", "released"], "the release")
    eventually(lambda: len(devices.faults()) == 2, "both faults")


def test_a_camera_that_hangs_while_it_is_told_to_hold_keeps_nobody_waiting_and_is_released_when_it_is_back(
    devices: Devices, hardware: FakeHardware
) -> None:
    hang, left = Hang(), camera(hardware)
    left.on_hold = hang
    with devices.exposure_held():
        assert hang.entered.wait(5.0)
        devices.move(0.1, 0.1)
        devices.frames(["navcam_right"], time.monotonic(), 1.0)
    eventually(lambda: camera(hardware, "navcam_right").told[-1] == "released", "the release of the other")
    eventually(lambda: any("hold_exposure" in f.message for f in devices.faults()), "the fault")
    for _ in range(3):  # the next operations find it hanging; none queues up
        with devices.exposure_held(), pytest.raises(NoReply, match="hold_exposure has been under way"):
            devices.frames(["navcam_left"], time.monotonic(), 1.0)
    assert left.told == []
    left.on_hold = lambda: None
    hang.let_go()
    eventually(lambda: left.told == ["held", "released"], "the late hold's release")
    assert devices.frames(["navcam_left"], time.monotonic(), 1.0)
    assert devices.faults() == ()


def test_a_release_that_hangs_is_a_fault_of_that_camera_alone(
    devices: Devices, hardware: FakeHardware
) -> None:
    hang, left = Hang(), camera(hardware)
    left.on_release = hang
    with devices.exposure_held():
        pass
    assert hang.entered.wait(5.0)
    eventually(lambda: any("release_exposure" in f.message for f in devices.faults()), "the fault")
    with devices.exposure_held():
        devices.frames(["navcam_right"], time.monotonic(), 1.0)
    hang.let_go()
    eventually(lambda: devices.faults() == (), "the camera's return")


def test_joint_angles_are_pointed_at_although_a_camera_hangs_in_its_hold(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    hang = Hang()
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
                operation = client.wait(client.point(pan_rad=0.1, tilt_rad=0.1), timeout_s=10.0)
                assert operation["state"] == "done"
        assert hang.entered.is_set()
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
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(cameras_module, "SIZE_TIMEOUT_S", DEADLINE_S)
    hardware, hang = FakeHardware(), Hang()
    asked = Asked("navcam_left")
    asked.on_size = hang
    hardware.fake_cameras["navcam_left"] = asked
    devices = Devices(hardware, Limits((-2.0, 2.0), (-1.0, 1.0), 0.5), "0" * 64, SystemClock(), rig())
    try:
        assert devices.frames(["navcam_right"], time.monotonic(), 1.0)
        assert "size_px has been under way" in devices.faults()[0].message
        hang.let_go()
        eventually(lambda: devices.faults() == (), "the camera's return")
        assert devices.frames(["navcam_left"], time.monotonic(), 1.0)
    finally:
        devices.close()


def test_a_camera_that_hangs_when_asked_for_its_times_fails_its_own_pictures_only(
    devices: Devices, hardware: FakeHardware
) -> None:
    hang = Hang()
    asked = Asked("navcam_left")
    asked.on_times = hang
    devices._cameras._cameras["navcam_left"] = asked
    begun_s = time.monotonic()
    with pytest.raises(DriverError, match="navcam_left"):
        devices.frames(["navcam_left", "navcam_right"], time.monotonic(), 0.1)
    assert time.monotonic() - begun_s < 10.0
    assert devices.frames(["navcam_right"], time.monotonic(), 1.0)
    hang.let_go()
