"""What a camera driver promises (docs/drivers.md), tested on any camera."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from drivers.clock import SystemClock
from drivers.errors import DriverError
from drivers.interfaces import Camera
from mastctl.conform.checks import NotTried, PromiseBroken, expect, settings_tried
from mastctl.devices import frames as frame_checks
from mastctl.setup.camera_check import FRAME_TIMEOUT_S, GRACE_S, CameraCheck
from mastctl.testing.drivers.calls import beside, call, ended

log = logging.getLogger(__name__)

CLOSES_WITHIN_S = 3.0
WAITS_S = 6.0  # longer than a close may take, shorter than a call is waited for
FRAMES_EACH = 5


@dataclass
class CameraTrial:
    """A camera under test; frames are taken for ``seconds``.

    ``size_px`` is (width, height), None where that is not known; ``open_again`` opens the same camera once
    more after it was closed, None where that is not to be tried.
    """

    name: str
    driver: Camera
    size_px: tuple[int, int] | None = None
    seconds: float = 3.0
    open_again: Callable[[], Camera] | None = None

    @cached_property
    def taken(self) -> tuple[CameraCheck, dict[str, Any]]:
        """The check that took frames for some seconds, and its summary."""
        check = CameraCheck(self.name, self.driver, SystemClock(), self.size_px)
        return check, check.run(self.seconds)

    def summary(self, promise: str) -> dict[str, Any]:
        """Return the summary of the frames. Raises PromiseBroken for what was found against a promise."""
        check, summary = self.taken
        problems = check.problems(promise)
        expect(not problems, "; ".join(problems[:3]))
        if promise != "frames" and not summary["frames"]:
            raise NotTried("no frame came")
        return summary

    def frame(self, camera: Camera, timeout_s: float = FRAME_TIMEOUT_S) -> Any:
        """Take a frame exposed from now on; it is one that can be true."""
        after_s = time.monotonic()
        answer = camera.next_frame(after_s, timeout_s)
        return frame_checks.checked(answer, self.name, self.size_px, after_s, time.monotonic())


def test_frames(camera: CameraTrial) -> None:
    """Frames come, of the right kind and size, none dark, none from the future."""
    summary = camera.summary("frames")
    expect(summary["frames"], f"no frame came within {camera.seconds:g} s")
    rate = "" if summary["rate_hz"] is None else f", {summary['rate_hz']:.2f} Hz"
    width, height = summary["size_px"]
    log.info(f"{summary['frames']} frames of {width}x{height} px{rate}")


def test_fresh(camera: CameraTrial) -> None:
    """No frame comes whose exposure began before the requested moment."""
    low, median, high = (1e3 * delay_s for delay_s in camera.summary("fresh")["delay_s"])
    log.info(f"from the exposure's end to arrival {low:.1f} to {high:.1f} ms, median {median:.1f} ms")


def test_order(camera: CameraTrial) -> None:
    """Counts and times of frames grow together."""
    log.info(f"{camera.summary('order')['missed']} passed over")


def test_refusal(camera: CameraTrial) -> None:
    """A frame that cannot come in time is refused in time, with NoFreshFrame."""
    camera.summary("refusal")


def test_stated(camera: CameraTrial) -> None:
    """Size and pace, where it states them, are those of its frames."""
    log.info(", ".join(camera.summary("stated")["abilities"]) or "it states nothing")


def test_threads(camera: CameraTrial) -> None:
    """Two threads at once both get fresh frames."""

    def work() -> None:
        for _ in range(FRAMES_EACH):
            camera.frame(camera.driver)

    for one in [beside(work) for _ in range(2)]:
        try:
            ended("next_frame() beside another", one, FRAMES_EACH * (FRAME_TIMEOUT_S + GRACE_S))
        except DriverError as error:
            raise PromiseBroken(f"next_frame() beside another: {error}") from None


def test_settings(camera: CameraTrial) -> None:
    """A setting that is changed by a little is read back, on new frames, and put back."""
    driver = camera.driver
    tried = settings_tried(
        lambda: call("settings()", driver.settings),
        lambda name, value: call("adjust()", lambda: driver.adjust({name: value})),
        lambda: camera.frame(driver).settings,
    )
    log.info(tried)


def test_close(camera: CameraTrial) -> None:
    """Close ends a call that waits, twice does no harm, and then no frame comes."""
    driver = camera.driver
    waits = beside(lambda: driver.next_frame(time.monotonic() + 60.0, WAITS_S))
    time.sleep(0.1)
    began_s = time.monotonic()
    for name in ("close()", "a second close()"):
        try:
            call(name, driver.close)
        except DriverError as error:
            raise PromiseBroken(f"{name} raised {type(error).__name__}: {error}") from None
    try:
        ended("next_frame() of a closed camera", waits)
        raise PromiseBroken("a frame that cannot have been exposed yet came when the camera was closed")
    except DriverError:
        took_s = time.monotonic() - began_s
    expect(took_s < CLOSES_WITHIN_S, f"close, and the call that waited, took {took_s:.1f} s")
    try:
        call("next_frame() of a closed camera", lambda: driver.next_frame(time.monotonic(), 1.0))
    except DriverError:
        pass
    else:
        raise PromiseBroken("a closed camera gave a frame")
    if camera.open_again is None:
        return
    camera.driver = camera.open_again()
    call("next_frame()", lambda: camera.frame(camera.driver))
    log.info(f"within {took_s:.2f} s, and opened again")
