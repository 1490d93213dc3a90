"""``mastctl camera check --config FILE NAME`` serves any driver and finds what breaks its promises."""

from __future__ import annotations

import json
import threading

import numpy as np
import pytest

from drivers.errors import NoFreshFrame
from drivers.interfaces import Camera, Frame
from mastctl.setup.camera_check import CameraCheck

IMAGE = np.random.default_rng(1).integers(0, 256, (48, 64), dtype=np.uint8)
PERIOD_S, EXPOSURE_S = 0.02, 0.005


class Clock:
    """A clock that the camera's waiting turns."""

    def __init__(self) -> None:
        self.time_s = 50.0

    def now_s(self) -> float:
        return self.time_s

    def sleep(self, duration_s: float) -> None:
        self.time_s += duration_s


class Eye(Camera):
    """A right camera of 50 Hz on that clock, with one thing wrong if a test says so."""

    def __init__(self, clock: Clock, wrong: str = "") -> None:
        self.clock, self.wrong, self.back = clock, wrong, threading.Event()
        self.calls = 0

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Frame:
        self.calls += 1
        sequence = int(np.floor(exposed_after_s / PERIOD_S + 1e-9)) + 1
        began_s = sequence * PERIOD_S
        if began_s > self.clock.time_s + timeout_s and self.wrong != "old":
            if self.wrong == "raises":
                raise RuntimeError("no such frame")
            raise NoFreshFrame("none yet")
        self.clock.time_s = max(self.clock.time_s, began_s + EXPOSURE_S)
        if self.wrong == "old" and self.calls % 7 == 0:
            began_s = exposed_after_s - 0.3
        if self.wrong == "count" and self.calls == 9:
            sequence = 3
        if self.wrong == "future":
            began_s += 0.2
        image = IMAGE[:, :32] if self.wrong == "size" else IMAGE
        if self.wrong == "nothing":
            return None  # type: ignore[return-value]
        return Frame(image.copy(), sequence, began_s + EXPOSURE_S / 2, EXPOSURE_S)

    def close(self) -> None: ...


def found(eye: Eye, clock: Clock) -> dict[str, object]:
    return CameraCheck("eye", eye, clock, (64, 48)).run(0.2)  # type: ignore[arg-type]


def test_a_camera_that_keeps_its_promises_has_no_problem() -> None:
    clock = Clock()
    told = found(Eye(clock), clock)
    assert told["problems"] == [] and told["refused"] == 0 and told["missed"] == 0
    assert told["rate_hz"] == pytest.approx(50.0) and told["size_px"] == [64, 48]
    assert told["exposure_s"] == [pytest.approx(EXPOSURE_S)] * 2
    json.dumps(told, allow_nan=False)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ("old", "was exposed 0.300 s before the requested moment"),
        ("old", "requested a frame exposed in 60 s, within 0.2 s: one came that was exposed before"),
        ("count", "count and time must grow together"),
        ("future", "stamped to end 0.200 s in the future"),
        ("size", "the image is 32x48 px where the mast file has 64x48 px"),
    ],
)
def test_what_breaks_a_promise_is_told_in_a_sentence(wrong: str, words: str) -> None:
    clock = Clock()
    problems = found(Eye(clock, wrong), clock)["problems"]
    assert any(words in problem for problem in problems), problems  # type: ignore[attr-defined]
