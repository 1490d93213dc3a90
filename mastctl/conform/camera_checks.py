"""What a camera driver promises (docs/drivers.md), asked of any camera."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from drivers.clock import SystemClock
from drivers.errors import DriverError
from drivers.interfaces import Camera
from mastctl.conform.checks import NotTried, PromiseBroken, Suite, expect
from mastctl.conform.settings_trial import settings_tried
from mastctl.conform.worker import beside, ended
from mastctl.devices import frames as frame_checks
from mastctl.setup.camera_check import FRAME_TIMEOUT_S, GRACE_S, CameraCheck

CAMERAS: Suite[CameraTrial] = Suite()

CLOSES_WITHIN_S = 3.0
WAITS_S = 6.0  # longer than a close may take, shorter than a call is waited for
FRAMES_EACH = 5


@dataclass
class CameraTrial:
    """A camera under test.

    Attributes
    ----------
    name, camera
        What it is called, and the driver's object.
    size_px
        (width, height) of its pictures; None where nobody says it.
    seconds
        How long frames are taken, one after the other.
    open_again
        Opens the same camera once more after it was closed; None where that is not to be tried.
    """

    name: str
    camera: Camera
    size_px: tuple[int, int] | None = None
    seconds: float = 3.0
    open_again: Callable[[], Camera] | None = None

    @cached_property
    def taken(self) -> tuple[CameraCheck, dict[str, Any]]:
        """The check that took frames for some seconds, and what it tells."""
        check = CameraCheck(self.name, self.camera, SystemClock(), self.size_px)
        return check, check.run(self.seconds)

    def kept(self, promise: str) -> dict[str, Any]:
        """Return what is told of the frames. Raises PromiseBroken for what was found against a promise."""
        check, told = self.taken
        problems = check.problems(promise)
        expect(not problems, "; ".join(problems[:3]))
        if promise != "frames" and not told["frames"]:
            raise NotTried("no frame came")
        return told

    def frame(self, camera: Camera, timeout_s: float = FRAME_TIMEOUT_S) -> Any:
        """Take a frame exposed from now on; it is one that can be true."""
        after_s = time.monotonic()
        answer = camera.next_frame(after_s, timeout_s)
        return frame_checks.checked(answer, self.name, self.size_px, after_s, time.monotonic())


@CAMERAS.check("camera.frames", "frames come, of the right kind and size, none dark, none from the future")
def _frames(trial: CameraTrial) -> str:
    told = trial.kept("frames")
    expect(told["frames"], f"no frame came within {trial.seconds:g} s")
    rate = "" if told["rate_hz"] is None else f", {told['rate_hz']:.2f} Hz"
    return f"{told['frames']} frames of {told['size_px'][0]}x{told['size_px'][1]} px{rate}"


@CAMERAS.check("camera.fresh", "no frame comes whose exposure began before the asked moment")
def _fresh(trial: CameraTrial) -> str:
    low, median, high = (1e3 * delay_s for delay_s in trial.kept("fresh")["delay_s"])
    return f"from the exposure's end to here {low:.1f} to {high:.1f} ms, median {median:.1f} ms"


@CAMERAS.check("camera.order", "counts and times of frames grow together")
def _order(trial: CameraTrial) -> str:
    return f"{trial.kept('order')['missed']} passed over"


@CAMERAS.check("camera.refusal", "a frame that cannot come in time is refused in time, with NoFreshFrame")
def _refusal(trial: CameraTrial) -> None:
    trial.kept("refusal")


@CAMERAS.check("camera.told", "size and pace, where it states them, are those of its frames")
def _told(trial: CameraTrial) -> str:
    return ", ".join(trial.kept("told")["abilities"]) or "it tells nothing"


@CAMERAS.check("camera.threads", "two threads that ask at once both get fresh frames")
def _threads(trial: CameraTrial) -> None:
    def work() -> None:
        for _ in range(FRAMES_EACH):
            trial.frame(trial.camera)

    for call in [beside(work) for _ in range(2)]:
        try:
            ended("next_frame() beside another", call, FRAMES_EACH * (FRAME_TIMEOUT_S + GRACE_S))
        except DriverError as error:
            raise PromiseBroken(f"next_frame() beside another: {error}") from None


@CAMERAS.check(
    "camera.settings", "a setting that is changed by a little is read back, on new frames, and put back"
)
def _settings(trial: CameraTrial) -> str:
    camera = trial.camera
    return settings_tried(
        lambda: ended("settings()", beside(camera.settings)),
        lambda name, value: ended("adjust()", beside(lambda: camera.adjust({name: value}))),
        lambda: trial.frame(camera).settings,
    )


@CAMERAS.check("camera.close", "close ends a call that waits, twice does no harm, and then no frame comes")
def _close(trial: CameraTrial) -> str | None:
    camera = trial.camera
    waits = beside(lambda: camera.next_frame(time.monotonic() + 60.0, WAITS_S))
    time.sleep(0.1)
    began_s = time.monotonic()
    for words in ("close()", "a second close()"):
        try:
            ended(words, beside(camera.close))
        except DriverError as error:
            raise PromiseBroken(f"{words} raised {type(error).__name__}: {error}") from None
    try:
        ended("next_frame() of a closed camera", waits)
        raise PromiseBroken("a frame that cannot have been exposed yet came when the camera was closed")
    except DriverError:
        took_s = time.monotonic() - began_s
    expect(took_s < CLOSES_WITHIN_S, f"close, and the call that waited, took {took_s:.1f} s")
    try:
        ended("next_frame() of a closed camera", beside(lambda: camera.next_frame(time.monotonic(), 1.0)))
    except DriverError:
        pass
    else:
        raise PromiseBroken("a closed camera gave a frame")
    if trial.open_again is None:
        return None
    trial.camera = trial.open_again()
    ended("next_frame()", beside(lambda: trial.frame(trial.camera)))
    return f"within {took_s:.2f} s, and opened again"
