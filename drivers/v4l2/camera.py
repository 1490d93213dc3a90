"""The driver ``v4l2``: a camera whose frames are never older than asked for (`drivers.interfaces.Camera`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from drivers.clock import Clock, SystemClock
from drivers.errors import NoFreshFrame
from drivers.interfaces import Frame, FrameTime
from drivers.v4l2 import find, pixels
from drivers.v4l2.capture import Bytes, Capture
from drivers.v4l2.controls import get_value, list_controls
from drivers.v4l2.errors import NoCamera
from drivers.v4l2.exposure import GROUPS, ExposureControl
from drivers.v4l2.frames import Arrived, Counters
from drivers.v4l2.options import CameraOptions, parse_options
from drivers.v4l2.stream import Stream, sizes_text

JUDGE_EVERY_S = 0.25  # how often the automatic exposure looks at a frame
SETTLE_PERIODS = 3  # a new exposure time shows this many frames later at most


@dataclass(frozen=True, eq=False)
class V4l2Frame(Frame):
    """A frame with what is known of its time.

    ``exposure_s`` of `Frame` is here the window in which the exposure of all rows surely lay, and
    ``mid_exposure_s`` is its middle.

    Attributes
    ----------
    mid_uncertainty_s
        The most that the true mid-exposure may be away from ``mid_exposure_s``.
    set_exposure_s
        The camera's own exposure time, None if not known.
    stamp_s, received_s
        The kernel's stamp, and when the frame was dequeued, seconds of CLOCK_MONOTONIC.
    driver_sequence, stream
        The driver's count, which starts anew with each stream, and the stream's number.
    """

    mid_uncertainty_s: float
    set_exposure_s: float | None
    stamp_s: float
    received_s: float
    driver_sequence: int
    stream: int


def open_camera(options: Mapping[str, Any], clock: Clock | None = None, name: str = "v4l2") -> V4l2Camera:
    """Open a camera by a configuration's options (docs/cameras.md).

    Raises
    ------
    BadOptions
        For options that it refuses; UnsupportedFormat and NotACamera are of this kind.
    DriverError
        If the camera is not connected, busy, or not to be opened by this user.
    """
    return V4l2Camera(parse_options(options, name), name, clock or SystemClock())


class V4l2Camera:
    """One camera, an instance of ``drivers.interfaces.Camera``; safe from any thread."""

    def __init__(self, options: CameraOptions, name: str, clock: Clock) -> None:
        self.name = name
        self._options = options
        self._clock = clock
        self._exposure: ExposureControl | None = None
        self._judge_after_s = 0.0
        if options.auto_exposure is not None and options.exposure_s is not None:
            self._exposure = GROUPS.join(name, options.auto_exposure, options.exposure_s)
        try:
            self.capture = Capture(
                options,
                name,
                clock,
                pixels.colour if options.colour else pixels.grey,
                None if self._exposure is None else self._judge,
                None if self._exposure is None else lambda: self._auto().exposure_s,
            )
        except BaseException:
            self._leave_group()
            raise
        self._last: V4l2Frame | None = None

    @property
    def counters(self) -> Counters:
        """What happened to the frames so far."""
        return self.capture.counters

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) of every picture."""
        return self.capture.format.size_px

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> V4l2Frame:
        """Return the newest frame whose exposure surely began after ``exposed_after_s``, waiting if need be.

        Its stamp is at most a period and 5 ms old, or it came during the call.

        Raises
        ------
        NoFreshFrame
            If none came within ``timeout_s`` seconds; the message says what came instead.
        NoCamera
            At once, if the camera is gone.
        """
        damaged = self.capture.damaged
        taken = self.capture.take(exposed_after_s, timeout_s)
        if taken is None:
            if lost := self.capture.lost:
                raise NoCamera(lost)
            raise NoFreshFrame(self._instead(exposed_after_s, timeout_s, damaged), device=self.name)
        arrived, image = taken
        last = self._last
        if last is not None and last.image is image:
            return last
        buffer, window, exposure_s = arrived.buffer, arrived.window(), arrived.rule.exposure_s
        self._last = V4l2Frame(
            image=image,
            sequence=arrived.sequence,
            mid_exposure_s=window.mid_s,
            exposure_s=window.length_s,
            mid_uncertainty_s=window.mid_uncertainty_s(exposure_s),
            set_exposure_s=exposure_s,
            stamp_s=buffer.stamp_s,
            received_s=arrived.received_s,
            driver_sequence=buffer.sequence,
            stream=arrived.stream,
        )
        return self._last

    @property
    def period_s(self) -> float:
        """From frame to frame, seconds, by the driver's word."""
        return self.capture.period_s

    @property
    def trigger(self) -> str:
        """The name of the hardware trigger that exposes it; empty for a free-running camera."""
        return self._options.trigger

    def recent_times(self) -> list[FrameTime]:
        """Return the times of the last good frames of this stream, oldest first."""
        return [FrameTime(frame.sequence, frame.window().begin_s) for frame in self.capture.recent()]

    def abilities(self) -> dict[str, Any]:
        """Return what the camera offers, as JSON: ``formats`` and ``controls`` with their values now."""
        with find.open_node(self._options.address, self.name) as node:
            controls = list_controls(node)
            return {
                "formats": [
                    {"code": code, "readable": code in pixels.FORMATS, "sizes": sizes_text(node, code)}
                    for code in dict.fromkeys(node.formats())
                ],
                "controls": [
                    {
                        "name": c.name, "kind": c.kind, "value": get_value(node, c), "minimum": c.minimum,
                        "maximum": c.maximum, "step": c.step, "default": c.default, "menu": dict(c.menu),
                    }
                    for c in controls
                ],
            }  # fmt: skip

    @contextmanager
    def exposure_held(self) -> Iterator[None]:
        """Keep the exposure as it is inside the block: for a measurement that compares pictures."""
        if self._exposure is None:
            yield
            return
        self._exposure.hold()
        try:
            yield
        finally:
            self._exposure.release()

    def close(self) -> None:
        """Let go of the camera; a waiting call ends with NoFreshFrame."""
        self.capture.close()
        self._leave_group()

    def _auto(self) -> ExposureControl:
        assert self._exposure is not None
        return self._exposure

    def _leave_group(self) -> None:
        if self._exposure is not None and self._options.auto_exposure is not None:
            self._exposure = None
            GROUPS.leave(self.name, self._options.auto_exposure)

    def _judge(self, stream: Stream, frame: Arrived, data: Bytes) -> None:
        """In the capture thread: look at a frame now and then, and set the exposure that its group wants."""
        control = self._exposure
        if control is None or stream.exposure_s is None:
            return
        if control.exposure_s == stream.asked_exposure_s and frame.window().begin_s >= self._judge_after_s:
            self._judge_after_s = frame.received_s + JUDGE_EVERY_S
            if not control.held:
                control.see(self.name, pixels.grey(frame.format, data), control.exposure_s)
        if control.exposure_s != stream.asked_exposure_s:  # also when another camera of the group wanted it
            stream.set_exposure(control.exposure_s)
            self._judge_after_s = frame.received_s + SETTLE_PERIODS * stream.period_s

    def _instead(self, exposed_after_s: float, timeout_s: float, damaged_before: int) -> str:
        """What to say when no fresh frame came."""
        counters = self.counters
        message = f"no frame exposed after {exposed_after_s:.3f} s came within {timeout_s:g} s"
        damaged = counters.damaged - damaged_before
        if damaged:
            message += f"; {damaged} came damaged ({counters.last_damage})"
        last = self.capture.newest
        if last is None:
            return message if damaged else f"{message}; none came at all"
        age_s = exposed_after_s - last.window().begin_s
        if age_s < 0.0:  # late enough, but older than a frame that is still to come
            age_s = self._clock.now_s() - last.buffer.stamp_s
            return f"{message}; the last good one is frame {last.sequence}, {age_s:.3f} s old"
        return f"{message}; the last good one is frame {last.sequence}, exposed {age_s:.3f} s before"
