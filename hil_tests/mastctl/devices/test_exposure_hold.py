"""Exposures stay as they are while an operation runs, and no camera keeps an operation waiting for that."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from drivers.errors import Refused
from hil_tests.mastctl.devices.turned import Hang, Turned
from hil_tests.mastctl.service_fakes import (
    FakeCamera,
    FakeHardware,
)
from mastctl.devices.devices import Devices


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


def camera(hardware: FakeHardware, name: str = "navcam_left") -> HoldingCamera:
    found = hardware.fake_cameras[name]
    assert isinstance(found, HoldingCamera)
    return found


def failing(error: BaseException) -> Callable[[], None]:
    def fail() -> None:
        raise error

    return fail


def test_an_exposure_is_fixed_for_the_images_of_a_block(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    with pytest.raises(ZeroDivisionError), devices.exposure_fixed():
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
    with devices.exposure_fixed():
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
    with devices.exposure_fixed():
        devices.frames(["navcam_left", "navcam_right"], clock.now_s(), 2.0)
    clock.until(lambda: right.told == ["held", "picture", "released"], "the release of the other")
    assert left.told == ["picture"]
    (fault,) = devices.faults()
    assert fault.device == "navcam_left" and fault.until == "an operation can hold the exposure again"
    left.on_hold = lambda: None
    with devices.exposure_fixed():
        pass
    clock.until(lambda: left.told == ["picture", "held", "released"], "a hold that goes well")
    assert devices.faults() == ()
