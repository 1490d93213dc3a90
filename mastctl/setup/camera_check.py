"""The frames of a camera compared with what a driver promises, and the quality of its images.

``mastctl camera check`` reports it, and the acceptance of drivers (`mastctl.testing.drivers`) asserts it.
"""

from __future__ import annotations

import statistics
import time
from itertools import pairwise
from typing import Any

import cv2
import numpy as np

from calib.files.mast_file import sensor_mode_keys
from calib.geometry.mode import SensorMode
from drivers.clock import Clock
from drivers.errors import DriverError, NoFreshFrame
from drivers.interfaces import Camera, Frame, Image
from mastctl.devices import frames as frame_checks
from mastctl.devices.thread import DeviceThread

FRAME_TIMEOUT_S = 5.0
GRACE_S = 6.0  # beyond that a call hangs: the service gives it no more either
NEVER_S, SHORT_S = 60.0, 0.2  # how far in the future a frame is requested, and how long: refused in time
PACE_TOLERANCE = 0.2
MOST_PROBLEMS = 20


class CameraCheck:
    """One check of one open camera; its stamps are judged by ``clock``.

    ``size_px`` is (width, height) by the mast file, None where that does not know it.
    """

    def __init__(self, name: str, camera: Camera, clock: Clock, size_px: tuple[int, int] | None) -> None:
        self._name = name
        self._camera = camera
        self._clock = clock
        self._size_px = size_px
        self._frames: list[Frame] = []
        self._delays_s: list[float] = []
        self._refused = 0
        self._uncertainty_s: float | None = None
        self._problems: list[tuple[str, str]] = []

    def run(self, seconds: float) -> dict[str, Any]:
        """Take frames for some seconds and return what was found, as JSON.

        A driver that fails, hangs or answers what cannot be true is a problem in the answer, not an error.
        """
        thread = DeviceThread(self._name)
        try:
            self._take_frames(thread, seconds)
            self._request_the_future(thread)
        finally:
            thread.close(1.0)
        self._check_order()
        self._check_stated()
        return self._summary(seconds)

    @property
    def image(self) -> Image | None:
        """The last image that came."""
        return self._frames[-1].image if self._frames else None

    def problems(self, promise: str | None = None) -> list[str]:
        """Return what was found against a promise, or against any.

        Promises are ``frames`` (each can be true), ``fresh`` (none is from before the requested moment),
        ``order`` (count and time grow together), ``refusal`` (what cannot come is refused in time) and
        ``stated`` (what the camera states of itself).
        """
        return [message for about, message in self._problems if promise in (None, about)]

    def _problem(self, promise: str, message: str) -> None:
        if message not in self.problems() and len(self._problems) < MOST_PROBLEMS:
            self._problems.append((promise, message))

    def _next(self, thread: DeviceThread, after_s: float, timeout_s: float) -> Any:
        """The driver's answer, within a deadline. Raises DriverError."""
        return thread.call(
            "next_frame", lambda: self._camera.next_frame(after_s, timeout_s), timeout_s + GRACE_S
        )

    def _take_frames(self, thread: DeviceThread, seconds: float) -> None:
        """One frame after the other, by turns the next one and one exposed from now on."""
        until_s = time.monotonic() + seconds
        after_s = self._clock.now_s()
        while time.monotonic() < until_s:
            came = False
            try:
                answer = self._next(thread, after_s, FRAME_TIMEOUT_S)
                came = True
                now_s = self._clock.now_s()
                frame = frame_checks.checked(answer, self._name, self._size_px, after_s, now_s)
            except DriverError as error:
                self._refused += 1
                old = came and isinstance(error, NoFreshFrame)
                self._problem("fresh" if old else "frames", str(error))
                if self._refused >= MOST_PROBLEMS or (thread.faults() and not self._frames):
                    return
                after_s = self._clock.now_s()
                continue
            uncertainty_s = getattr(answer, "mid_uncertainty_s", None)
            self._uncertainty_s = uncertainty_s if isinstance(uncertainty_s, float) else None
            self._frames.append(frame)
            self._delays_s.append(now_s - (frame.mid_exposure_s + frame.exposure_s / 2))
            after_s = now_s if len(self._frames) % 5 == 0 else frame.exposure_began_s

    def _request_the_future(self, thread: DeviceThread) -> None:
        """A frame exposed after a minute from now cannot come; the driver has to say so in time."""
        began_s = time.monotonic()
        request = f"requested a frame exposed in {NEVER_S:g} s, within {SHORT_S:g} s"
        try:
            self._next(thread, self._clock.now_s() + NEVER_S, SHORT_S)
            self._problem("refusal", f"{request}: one came that was exposed before")
        except NoFreshFrame:
            took_s = time.monotonic() - began_s
            if took_s > SHORT_S + 1.0:
                self._problem("refusal", f"{request}: refused only after {took_s:.1f} s")
        except DriverError as error:
            self._problem("refusal", f"{request}: no NoFreshFrame was raised: {error}")

    def _check_order(self) -> None:
        """Count and time must grow together."""
        for before, frame in pairwise(self._frames):
            ahead, later_s = frame.sequence - before.sequence, frame.mid_exposure_s - before.mid_exposure_s
            if ahead <= 0 or later_s <= 0:
                self._problem(
                    "order",
                    f"frame {frame.sequence} came after frame {before.sequence}, {later_s:.3f} s later: "
                    "count and time must grow together",
                )

    def _check_stated(self) -> None:
        """What it states of itself must be what came."""
        info = self._camera.info
        if info.size_px is not None and self.image is not None:
            height, width = self.image.shape[:2]
            if tuple(info.size_px) != (width, height):
                message = f"info.size_px is {tuple(info.size_px)}, its images have ({width}, {height})"
                self._problem("stated", message)
        rate_hz, period_s = self._rate_hz(), info.period_s
        if period_s is not None and rate_hz and abs(period_s * rate_hz - 1) > PACE_TOLERANCE:
            message = f"info.period_s is {period_s:.4g} s, frames come every {1 / rate_hz:.4g} s"
            self._problem("stated", message)

    def _rate_hz(self) -> float | None:
        if len(self._frames) < 2:
            return None
        first, last = self._frames[0], self._frames[-1]
        counted, span_s = last.sequence - first.sequence, last.mid_exposure_s - first.mid_exposure_s
        return counted / span_s if counted > 0 and span_s > 0 else None

    def _summary(self, seconds: float) -> dict[str, Any]:
        frames, info = self._frames, self._camera.info
        summary: dict[str, Any] = {
            "camera": self._name,
            "seconds": seconds,
            "frames": len(frames),
            "refused": self._refused,
            "rate_hz": self._rate_hz(),
            "mid_exposure_uncertainty_s": self._uncertainty_s,
            "abilities": [name for name in STATED if getattr(info, name) is not None],
            "problems": self.problems(),
        }
        if isinstance(info.sensor_mode, SensorMode):
            summary |= sensor_mode_keys(info.sensor_mode)
        if self.image is not None:
            summary |= {
                "size_px": [self.image.shape[1], self.image.shape[0]],
                "colour": self.image.ndim == 3,
                "missed": sum(max(0, b.sequence - a.sequence - 1) for a, b in pairwise(frames)),
                "delay_s": [min(self._delays_s), statistics.median(self._delays_s), max(self._delays_s)],
                "exposure_s": [min(f.exposure_s for f in frames), max(f.exposure_s for f in frames)],
                "quality": quality_of(self.image),
            }
        return summary


STATED = ("size_px", "sensor_mode", "period_s")
DARK, SATURATED = 5, 250


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
