"""What a camera promises, tested on its frames, and calls to a device that come back in time.

``mastctl camera check`` and the acceptance of drivers (`mastctl.testing.drivers`) share them.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any, TypeVar

import cv2
import numpy as np

from calib.files.mast_file import sensor_mode_keys
from calib.geometry.mode import SensorMode
from drivers.clock import Clock, SystemClock
from drivers.errors import DriverError, NoFreshFrame
from drivers.interfaces import Camera, Frame, Image
from mastctl.devices import frames as frame_checks
from mastctl.devices.judge import OutsideLimits
from mastctl.devices.keep_out import KeptOut

T = TypeVar("T")

PATIENCE_S = 12.0
FRAME_TIMEOUT_S, GRACE_S = 5.0, 6.0  # the service gives a call no more than the grace beyond its timeout
NEVER_S, SHORT_S = 60.0, 0.2  # how far in the future a frame is requested, and how long: refused in time
PACE_TOLERANCE = 0.2
MOST_PROBLEMS = 20
STATED = ("size_px", "sensor_mode", "period_s")
DARK, SATURATED = 5, 250


class PromiseBroken(AssertionError):
    """What was promised does not hold; the message says what was found and what would be right."""


class NotTried(Exception):
    """The check does not apply to this device or daemon, or could not tell; the message says why."""


class SubjectLost(Exception):
    """What is tested does not answer any more: the checks that would follow cannot be tried."""


def expect(holds: object, message: str) -> None:
    """Raise PromiseBroken unless something holds."""
    if not holds:
        raise PromiseBroken(message)


def call(what: str, function: Callable[[], T], patience_s: float = PATIENCE_S) -> T:
    """Make a call in a thread of its own and wait for it. Raises as `ended`."""
    return ended(what, beside(function), patience_s)


def beside(function: Callable[[], T], clock: Clock | None = None) -> Future[T]:
    """Begin a call in a thread of its own, one of the clock's, and return at once."""
    future: Future[T] = Future()

    def run() -> None:
        try:
            future.set_result(function())
        except BaseException as error:  # a foreign driver may raise anything; the caller gets it
            future.set_exception(error)

    (clock or SystemClock()).thread(run, "device under test").start()
    return future


def ended(what: str, future: Future[T], patience_s: float = PATIENCE_S) -> T:
    """Return what a call returned; raise the driver's own DriverError.

    Raises NotTried if limits or keep-outs refused a move, PromiseBroken for any other error, SubjectLost if
    the call does not come back.
    """
    try:
        return future.result(patience_s)
    except DriverError:
        raise
    except (KeptOut, OutsideLimits) as error:
        raise NotTried(f"{what} was not sent: {error}") from None
    except BaseException as error:
        if not future.done():
            raise SubjectLost(f"{what} has not come back after {patience_s:g} s") from None
        message = " ".join(str(error).split())[:200]
        raise PromiseBroken(
            f"{what} raised {type(error).__name__} ({message}) where a DriverError is expected"
        ) from error


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
    _frames: list[Frame] = field(default_factory=list)
    _delays_s: list[float] = field(default_factory=list)
    _problems: list[tuple[str, str]] = field(default_factory=list)

    def frame(self) -> Frame:
        """Take a frame exposed from now on. Raises DriverError, PromiseBroken, SubjectLost."""
        after_s = time.monotonic()
        answer = self._answer(after_s, FRAME_TIMEOUT_S)
        return frame_checks.checked(answer, self.name, self.size_px, after_s, time.monotonic())

    @cached_property
    def summary(self) -> dict[str, Any]:
        """What some seconds of frames showed, as JSON; what a driver did wrong is in ``problems``."""
        try:
            refused = self._take_frames()
            self._request_the_future()
        except SubjectLost as error:
            refused = 1
            self._found("frames", str(error))
        self._check_stated()
        frames, info = self._frames, self.driver.info
        summary: dict[str, Any] = {
            "camera": self.name,
            "seconds": self.seconds,
            "frames": len(frames),
            "refused": refused,
            "rate_hz": self._rate_hz(),
            "abilities": [name for name in STATED if getattr(info, name) is not None],
            "problems": [message for _, message in self._problems],
        }
        if isinstance(info.sensor_mode, SensorMode):
            summary |= sensor_mode_keys(info.sensor_mode)
        if frames:
            image, delays_s = frames[-1].image, self._delays_s
            summary |= {
                "size_px": [image.shape[1], image.shape[0]],
                "colour": image.ndim == 3,
                "missed": sum(max(0, b.sequence - a.sequence - 1) for a, b in pairwise(frames)),
                "delay_s": [min(delays_s), statistics.median(delays_s), max(delays_s)],
                "exposure_s": [min(f.exposure_s for f in frames), max(f.exposure_s for f in frames)],
                "quality": quality_of(image),
            }
        return summary

    def kept(self, promise: str) -> dict[str, Any]:
        """Return the summary of the frames. Raises PromiseBroken for what was found against a promise.

        Promises are ``frames`` (each can be true), ``fresh`` (none is from before the requested moment),
        ``order`` (count and time grow together), ``refusal`` (what cannot come is refused in time) and
        ``stated`` (what the camera states of itself). Raises NotTried if no frame came.
        """
        summary = self.summary
        found = [message for about, message in self._problems if about == promise]
        expect(not found, "; ".join(found[:3]))
        if not summary["frames"]:
            expect(promise != "frames", f"no frame came within {self.seconds:g} s")
            raise NotTried("no frame came")
        return summary

    def _answer(self, after_s: float, timeout_s: float) -> Any:
        return call("next_frame()", lambda: self.driver.next_frame(after_s, timeout_s), timeout_s + GRACE_S)

    def _found(self, promise: str, message: str) -> None:
        if (promise, message) not in self._problems and len(self._problems) < MOST_PROBLEMS:
            self._problems.append((promise, message))

    def _take_frames(self) -> int:
        """Take one frame after the other, by turns the next one and one exposed from now on.

        Returns how many were refused. Raises SubjectLost.
        """
        refused, after_s = 0, time.monotonic()
        until_s = after_s + self.seconds
        while time.monotonic() < until_s and refused < MOST_PROBLEMS:
            came = False
            try:
                answer = self._answer(after_s, FRAME_TIMEOUT_S)
                came, now_s = True, time.monotonic()
                frame = frame_checks.checked(answer, self.name, self.size_px, after_s, now_s)
            except (DriverError, PromiseBroken) as error:
                refused += 1
                self._found("fresh" if came and isinstance(error, NoFreshFrame) else "frames", str(error))
                after_s = time.monotonic()
                continue
            before = self._frames[-1] if self._frames else None
            later_s = frame.mid_exposure_s - before.mid_exposure_s if before else 0.0
            if before and (frame.sequence <= before.sequence or later_s <= 0.0):
                message = f"frame {frame.sequence} came after frame {before.sequence}, {later_s:.3f} s later"
                self._found("order", f"{message}: count and time must grow together")
            self._frames.append(frame)
            self._delays_s.append(now_s - (frame.mid_exposure_s + frame.exposure_s / 2))
            after_s = now_s if len(self._frames) % 5 == 0 else frame.exposure_began_s
        return refused

    def _request_the_future(self) -> None:
        """A frame exposed after a minute from now cannot come; the driver has to say so in time."""
        began_s = time.monotonic()
        request = f"requested a frame exposed in {NEVER_S:g} s, within {SHORT_S:g} s"
        try:
            self._answer(began_s + NEVER_S, SHORT_S)
            self._found("refusal", f"{request}: one came that was exposed before")
        except NoFreshFrame:
            took_s = time.monotonic() - began_s
            if took_s > SHORT_S + 1.0:
                self._found("refusal", f"{request}: refused only after {took_s:.1f} s")
        except (DriverError, PromiseBroken) as error:
            self._found("refusal", f"{request}: no NoFreshFrame was raised: {error}")

    def _check_stated(self) -> None:
        """What it states of itself must be what came."""
        info, rate_hz = self.driver.info, self._rate_hz()
        if info.size_px is not None and self._frames:
            height, width = self._frames[-1].image.shape[:2]
            if tuple(info.size_px) != (width, height):
                message = f"info.size_px is {tuple(info.size_px)}, its images have ({width}, {height})"
                self._found("stated", message)
        if info.period_s is not None and rate_hz and abs(info.period_s * rate_hz - 1) > PACE_TOLERANCE:
            message = f"info.period_s is {info.period_s:.4g} s, frames come every {1 / rate_hz:.4g} s"
            self._found("stated", message)

    def _rate_hz(self) -> float | None:
        if len(self._frames) < 2:
            return None
        first, last = self._frames[0], self._frames[-1]
        counted, span_s = last.sequence - first.sequence, last.mid_exposure_s - first.mid_exposure_s
        return counted / span_s if counted > 0 and span_s > 0 else None


def quality_of(image: Image) -> dict[str, Any]:
    """Return exposure and sharpness of an image, uint8 (h, w) or (h, w, 3) BGR.

    ``histogram`` has the shares of the pixels in 16 equal ranges of grey level, 0 to 255; ``dark_share`` and
    ``saturated_share`` are those at or below 5, and at or above 250.
    """
    grey = _grey(image)
    return {
        "histogram": (np.histogram(grey, bins=16, range=(0, 256))[0] / grey.size).tolist(),
        "mean": float(grey.mean()),
        "dark_share": float((grey <= DARK).mean()),
        "saturated_share": float((grey >= SATURATED).mean()),
        "sharpness": sharpness(image),
    }


def sharpness(image: Image, around_px: tuple[float, float] | None = None, half_px: int = 100) -> float:
    """Return the variance of the Laplacian, of the whole image or of a square around a pixel (x, y).

    Compare it only between images of the same scene and exposure.
    """
    grey = _grey(image)
    if around_px is not None:
        x, y = (round(value) for value in around_px)
        grey = grey[max(0, y - half_px) : y + half_px + 1, max(0, x - half_px) : x + half_px + 1]
    return float(cv2.Laplacian(grey, cv2.CV_64F).var())


def _grey(image: Image) -> Image:
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
