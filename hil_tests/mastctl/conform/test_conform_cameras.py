"""Every test of a camera passes a right one, and finds the driver that breaks its promise."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import DriverError, NoFreshFrame, NoReply
from drivers.interfaces import CameraInfo, Frame
from hil_tests.mastctl.conform.conform_world import HERE, NoiseCamera, accepted
from hil_tests.mastctl.service_fakes import SIZE_PX
from mastctl.conform.device_checks import CameraTrial
from mastctl.testing.drivers import test_camera as suite

Test = Callable[[CameraTrial], None]
TESTS = [one for name, one in vars(suite).items() if name.startswith("test_")]


def frames(edit: Callable[[Frame, float], Any]) -> type[NoiseCamera]:
    """A camera whose frames are edited; ``edit`` is given the asked moment too."""

    class Frames(NoiseCamera):
        def next_frame(self, exposed_after_s: float, timeout_s: float) -> Any:
            return edit(super().next_frame(exposed_after_s, timeout_s), exposed_after_s)

    return Frames


class Old(NoiseCamera):
    """Gives its buffer first."""

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Frame:
        frame = super().next_frame(exposed_after_s, timeout_s)
        return replace(frame, mid_exposure_s=min(frame.mid_exposure_s, exposed_after_s - 0.01))


class Never(NoiseCamera):
    """Waits as long as it takes."""

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Frame:
        if exposed_after_s > time.monotonic() + 1.0:
            time.sleep(2.0)
            raise NoFreshFrame("none")
        return super().next_frame(exposed_after_s, timeout_s)


class OtherPace(NoiseCamera):
    @property
    def info(self) -> CameraInfo:
        return CameraInfo(period_s=0.1)


class OtherSize(NoiseCamera):
    @property
    def info(self) -> CameraInfo:
        return CameraInfo(size_px=(1024, 768))


class OneAtATime(NoiseCamera):
    def __init__(self) -> None:
        super().__init__()
        self.busy = threading.Lock()

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Frame:
        if not self.busy.acquire(blocking=False):
            raise DriverError("the buffer is taken")
        try:
            return super().next_frame(exposed_after_s, timeout_s)
        finally:
            self.busy.release()


class Forgets(NoiseCamera):
    """Takes a value, and has its own."""

    def adjust(self, wanted: Mapping[str, float]) -> list[str]:
        return []


class ClosesOnce(NoiseCamera):
    def close(self) -> None:
        if self._closed.is_set():
            raise NoReply("it is closed already")
        super().close()


BROKEN: list[tuple[str, Test, type[NoiseCamera]]] = [
    ("nothing", suite.test_frames, frames(lambda frame, asked_s: None)),
    ("floats", suite.test_frames, frames(lambda frame, asked_s: replace(frame, image=frame.image / 255.0))),  # type: ignore[arg-type]
    ("another size", suite.test_frames,
     frames(lambda frame, asked_s: replace(frame, image=frame.image[::2]))),
    ("dark", suite.test_frames, frames(lambda frame, asked_s: replace(frame, image=frame.image // 64))),
    ("the future", suite.test_frames,
     frames(lambda frame, asked_s: replace(frame, mid_exposure_s=frame.mid_exposure_s + 0.5))),
    ("old frames", suite.test_fresh, Old),
    ("one count for all", suite.test_order, frames(lambda frame, asked_s: replace(frame, sequence=7))),
    ("no deadline", suite.test_refusal, Never),
    ("another pace than told", suite.test_stated, OtherPace),
    ("another size than told", suite.test_stated, OtherSize),
    ("one call at a time", suite.test_threads, OneAtATime),
    ("a value that is not taken", suite.test_settings, Forgets),
    ("frames of the value before", suite.test_settings,
     frames(lambda frame, asked_s: replace(frame, settings={"gain": 8.0}))),
    ("frames of no known value", suite.test_settings,
     frames(lambda frame, asked_s: replace(frame, settings={"gain": None}))),
    ("close once only", suite.test_close, ClosesOnce),
]  # fmt: skip


@pytest.mark.parametrize(("test", "kind"), [one[1:] for one in BROKEN], ids=[one[0] for one in BROKEN])
def test_a_broken_camera_is_found_by_the_test_meant_for_it(test: Test, kind: type[NoiseCamera]) -> None:
    with pytest.raises((AssertionError, DriverError)) as failed:
        test(CameraTrial("camera", kind(), SIZE_PX, 0.3))
    assert "\n" not in str(failed.value)


def test_a_right_camera_keeps_every_promise() -> None:
    camera = CameraTrial("camera", NoiseCamera(), SIZE_PX, 0.3, NoiseCamera)
    for test in TESTS:
        test(camera)


def test_there_is_a_broken_camera_for_every_test() -> None:
    assert {test for _, test, _ in BROKEN} == set(TESTS)


def test_the_suite_takes_a_camera_by_its_driver(tmp_path: Path) -> None:
    done = accepted(tmp_path, "--camera", f"{HERE}:NoiseCamera", "--seconds", "0.3")
    assert done.returncode == 0 and f"{len(TESTS)} passed" in done.stdout, done.stdout
