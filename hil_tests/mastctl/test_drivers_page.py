"""What docs/drivers.md says to an author of a driver is what the service does."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers import interfaces
from drivers.clock import SystemClock
from drivers.errors import DriverError
from drivers.hardware import BUILT_IN
from drivers.interfaces import Frame, Reading
from hil_tests.mastctl.service_fakes import FakeHardware, Hang, rig
from hil_tests.waiting import until
from mastctl.devices import devices as devices_module
from mastctl.devices import frames, joint_history, stops
from mastctl.devices.cameras import CAMERA_GRACE_S
from mastctl.devices.devices import Devices
from mastctl.devices.limits import Limits
from mastctl.motion.settings import PointingSettings
from mastctl.service import service as service_module


@pytest.fixture(scope="module")
def page(repository: Path) -> str:
    text = (repository / "docs" / "drivers.md").read_text(encoding="utf-8")
    return " ".join(text.split("## What a driver promises", 1)[1].split("\n## ", 1)[0].split())


def test_every_driver_has_its_row(repository: Path) -> None:
    text = (repository / "docs" / "drivers.md").read_text(encoding="utf-8")
    named = re.findall(r"^\| `([^`]+)` \|", text.split("## What a driver promises", 1)[0], re.MULTILINE)
    assert {*named} == {*BUILT_IN, "package.module:factory"}


@pytest.fixture
def made() -> Any:
    """Fake devices behind the service's checks."""
    hardware = FakeHardware()
    made = Devices(hardware, Limits((-2, 2), (-1, 1), 0.5), "0" * 64, SystemClock(), rig())
    yield hardware, made
    made.close()


def test_deadlines_and_periods_are_the_programs_own(page: str) -> None:
    m, s = devices_module, PointingSettings()
    allowed_s = s.acceleration_s + s.dwell_s + s.margin_s
    for words in (
        f"| `read()` | {m.READ_TIMEOUT_S:g} s |",
        f"| {m.MOVE_TIMEOUT_S:g} s | returns at once",
        f"| `stop()` | {m.STOP_TIMEOUT_S:g} s |",
        f"has been busy for {stops.PATIENCE_S:g} s",
        f"`timeout_s` and {CAMERA_GRACE_S:g} s |",
        f"up to {s.frame_timeout_s:g} s for a pointing and "
        f"{service_module.SNAPSHOT_TIMEOUT_S:g} s for a snapshot",
        f"a camera has {s.frame_timeout_s + CAMERA_GRACE_S:g} s in all",
        f"| `close()` | {service_module.HARDWARE_CLOSE_S:g} s for all devices",
        f"{1 / m.MOVING_PERIOD_S:g} times a second while the head moves, {1 / m.RESTING_PERIOD_S:g} times",
        f"rests within {s.arrival_tolerance_rad:g} rad of the angles sent",
        f"({joint_history.SAME_RAD:g} rad) for {s.dwell_s:g} s",
        f"for {joint_history.DITHER_S:g} s its readings lie within "
        f"{s.rest_tolerance_rad:g} rad of each other",
        f"the way over the speed, and {allowed_s:g} s",
        f"more than {joint_history.CLOCK_TOLERANCE_S:g} s in the future, "
        f"more than {joint_history.OLDEST_READING_S:g} s back",
        f"ends more than {frames.CLOCK_TOLERANCE_S:g} s in the future",
        f"brightest hundredth is below {frames.DARK_GREY} of 255",
    ):
        assert words in page, words


def test_every_optional_protocol_is_on_the_page(page: str) -> None:
    needed = {"PanTilt", "Camera"}
    optional = {
        name
        for name, thing in vars(interfaces).items()
        if getattr(thing, "_is_protocol", False) and thing.__module__ == interfaces.__name__
    }
    assert optional >= needed and "SaysSimulated" in optional
    for name in (*(optional - needed), "Reporting"):
        assert f"| `{name}` |" in page, name
        for attribute in interfaces.__dict__[name].__dict__:
            if not attribute.startswith("_"):
                assert re.search(rf"\| `{name}` \|[^|]*`{attribute}", page), f"{name}.{attribute}"


READINGS: list[tuple[Callable[[float], Any], str | None]] = [
    (lambda now: Reading(6.2, -6.2, False, now, ["the fan stands still"]), None),
    (lambda now: Reading(6.3, 0.0, False, now), "bad_reply"),
    (lambda now: Reading(float("nan"), 0.0, False, now), "bad_reply"),
    (lambda now: Reading(0.0, 0.0, 1, now), "bad_reply"),  # type: ignore[arg-type]
    (lambda now: Reading(0.0, 0.0, False, now + 0.5), "bad_reply"),
    (lambda now: Reading(0.0, 0.0, False, now - 1.5), "bad_reply"),
]


@pytest.mark.parametrize("number", range(len(READINGS)))
def test_readings_are_taken_and_refused_as_the_page_says(made: Any, number: int) -> None:
    hardware, devices = made
    answer, code = READINGS[number]
    hardware.head.answer = lambda head: answer(time.monotonic())
    if code is None:
        assert devices.read().pan_rad == 6.2
        assert any("the fan stands still" in fault.message for fault in devices.faults())
    else:
        with pytest.raises(DriverError) as refused:
            devices.read()
        assert refused.value.code == code


def other(image: Any = None, **changes: Any) -> Callable[[Frame], Frame]:
    """A frame with something else in it."""

    def change(frame: Frame) -> Frame:
        values = {name: getattr(frame, name) for name in ("sequence", "mid_exposure_s", "exposure_s")}
        values |= {name: values[name] + by for name, by in changes.items()}
        return Frame(frame.image if image is None else image(frame.image), **values)

    return change


FRAMES: list[tuple[Callable[[Frame], Frame], str | None]] = [
    (other(), None),
    (other(lambda image: np.dstack([image] * 3)), None),
    (other(lambda image: image.astype(np.uint16)), "bad_frame"),
    (other(lambda image: image.astype(float)), "bad_frame"),
    (other(lambda image: image[..., None]), "bad_frame"),
    (other(lambda image: np.dstack([image] * 4)), "bad_frame"),
    (other(lambda image: image.T), "bad_frame"),
    (other(lambda image: image // 64), "bad_frame"),
    (other(sequence=-100), "bad_frame"),
    (other(mid_exposure_s=0.5), "bad_frame"),
    (other(exposure_s=-1.0), "bad_frame"),
    (other(mid_exposure_s=-0.5), "no_fresh_frame"),
]


@pytest.mark.parametrize("number", range(len(FRAMES)))
def test_frames_are_taken_and_refused_as_the_page_says(made: Any, number: int) -> None:
    hardware, devices = made
    change, code = FRAMES[number]
    hardware.fake_cameras["navcam_left"].change = change
    if code is None:
        taken = devices.frames(["navcam_left"], time.monotonic(), 5.0)["navcam_left"]
        assert not taken.image.flags.writeable
    else:
        with pytest.raises(DriverError) as refused:
            devices.frames(["navcam_left"], time.monotonic(), 5.0)
        assert refused.value.code == code


def test_a_stop_comes_beside_a_call_under_way_from_another_thread(made: Any) -> None:
    hardware, devices = made
    hang, stopped_in = Hang(), []

    def hook(name: str) -> None:
        if name == "stop":
            stopped_in.append(threading.get_ident())
        elif name == "read":
            reading_in.append(threading.get_ident())
            hang()

    reading_in: list[int] = []
    hardware.head.hook = hook
    try:
        until(hang.entered.is_set, "a read under way")
        devices.stop()
        assert stopped_in and stopped_in[0] not in reading_in
    finally:
        hang.let_go()
