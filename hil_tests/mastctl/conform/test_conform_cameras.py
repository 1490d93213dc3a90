"""Every check of a camera passes a right one, and finds the driver that breaks its promise."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import pytest

from drivers.errors import DriverError, NoFreshFrame, NoReply
from drivers.interfaces import CameraInfo, Frame
from hil_tests.mastctl.conform.conform_world import HERE, NoiseCamera
from hil_tests.mastctl.service_fakes import SIZE_PX
from mastctl.cli.main import main
from mastctl.conform.camera_checks import CAMERAS, CameraTrial
from mastctl.conform.checks import run_checks

NAMES = [check.name for check in CAMERAS.checks]


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


BROKEN: list[tuple[str, str, type[NoiseCamera]]] = [
    ("nothing", "camera.frames", frames(lambda frame, asked_s: None)),
    ("floats", "camera.frames", frames(lambda frame, asked_s: replace(frame, image=frame.image / 255.0))),
    ("another size", "camera.frames", frames(lambda frame, asked_s: replace(frame, image=frame.image[::2]))),
    ("dark", "camera.frames", frames(lambda frame, asked_s: replace(frame, image=frame.image // 64))),
    ("the future", "camera.frames",
     frames(lambda frame, asked_s: replace(frame, mid_exposure_s=frame.mid_exposure_s + 0.5))),
    ("old frames", "camera.fresh", Old),
    ("one count for all", "camera.order", frames(lambda frame, asked_s: replace(frame, sequence=7))),
    ("no deadline", "camera.refusal", Never),
    ("another pace than told", "camera.told", OtherPace),
    ("another size than told", "camera.told", OtherSize),
    ("one call at a time", "camera.threads", OneAtATime),
    ("a value that is not taken", "camera.settings", Forgets),
    ("frames of the value before", "camera.settings",
     frames(lambda frame, asked_s: replace(frame, settings={"gain": 8.0}))),
    ("frames of no known value", "camera.settings",
     frames(lambda frame, asked_s: replace(frame, settings={"gain": None}))),
    ("close once only", "camera.close", ClosesOnce),
]  # fmt: skip


def states(camera: Any, *names: str, **known: Any) -> dict[str, tuple[str, str]]:
    trial = CameraTrial("eye", camera, SIZE_PX, 0.3, **known)
    checks = [check for check in CAMERAS.checks if check.name in names]
    return {
        outcome.name: (outcome.state, outcome.message) for outcome in run_checks(checks, trial, motion=False)
    }


@pytest.mark.parametrize(("name", "kind"), [one[1:] for one in BROKEN], ids=[one[0] for one in BROKEN])
def test_a_broken_camera_is_found_by_the_check_meant_for_it(name: str, kind: type[NoiseCamera]) -> None:
    state, message = states(kind(), name)[name]
    assert state == "failed" and "\n" not in message, message


def test_a_right_camera_keeps_every_promise() -> None:
    found = states(NoiseCamera(), *NAMES, open_again=NoiseCamera)
    assert {name: told for name, told in found.items() if told[0] != "passed"} == {}


def test_there_is_a_broken_camera_for_every_check() -> None:
    assert {name for _, name, _ in BROKEN} == set(NAMES)


def test_the_command_checks_a_camera_by_its_driver(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["conform", "--driver", f"{HERE}:NoiseCamera", "--camera", "--seconds", "0.3", "--json"]
    assert main([*words, "--size", "64", "48"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["kind"] == "camera" and [check["name"] for check in told["checks"]] == NAMES
    assert main([*words, "--size", "640", "480", "--only", "camera.frames"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert "64x48 px" in told["checks"][0]["message"]
