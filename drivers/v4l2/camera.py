"""The driver ``v4l2``: a camera whose frames are never older than asked for (`drivers.interfaces.Camera`)."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from drivers.clock import Clock, SystemClock
from drivers.errors import BadFrame, NoFreshFrame
from drivers.interfaces import Frame, Image
from drivers.v4l2 import find, pixels
from drivers.v4l2.capture import Capture
from drivers.v4l2.controls import get_value, list_controls
from drivers.v4l2.errors import NoCamera
from drivers.v4l2.exposure import GROUPS, ExposureControl
from drivers.v4l2.frames import Counters, RawFrame
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
    raw
        The camera's own bytes.
    """

    mid_uncertainty_s: float
    set_exposure_s: float | None
    stamp_s: float
    received_s: float
    driver_sequence: int
    stream: int
    raw: RawFrame

    def colour(self) -> Image:
        """Return the same picture in colour, uint8 (h, w, 3) BGR, for people to look at."""
        return self.image if self.image.ndim == 3 else pixels.colour(self.raw.format, self.raw.raw)


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
                None if self._exposure is None else self._judge,
                None if self._exposure is None else lambda: self._auto().exposure_s,
            )
        except BaseException:
            self._leave_group()
            raise
        self._converted: tuple[RawFrame, V4l2Frame] | None = None

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

        Raises
        ------
        NoFreshFrame
            If none came within ``timeout_s`` seconds; the message says what came instead.
        NoCamera
            At once, if the camera is gone.
        """
        before = self.counters
        began_s, left_s = time.monotonic(), timeout_s
        while True:
            raw = self.capture.wait(exposed_after_s, left_s)
            if raw is None:
                if lost := self.capture.lost:
                    raise NoCamera(lost)
                raise NoFreshFrame(self._instead(exposed_after_s, timeout_s, before), device=self.name)
            try:
                return self.converted(raw)
            except BadFrame as error:
                self.capture.refuse(raw, str(error))
                left_s = began_s + timeout_s - time.monotonic()

    def converted(self, raw: RawFrame) -> V4l2Frame:
        """Return a raw frame as a picture: grey, or BGR by the options. Raises BadFrame for a broken JPEG."""
        known = self._converted
        if known is not None and known[0] is raw:
            return known[1]
        convert = pixels.colour if self._options.colour else pixels.grey
        image = convert(raw.format, raw.raw)
        image.setflags(write=False)
        window = raw.window
        frame = V4l2Frame(
            image=image,
            sequence=raw.sequence,
            mid_exposure_s=window.mid_s,
            exposure_s=window.length_s,
            mid_uncertainty_s=window.mid_uncertainty_s(raw.exposure_s),
            set_exposure_s=raw.exposure_s,
            stamp_s=raw.stamp_s,
            received_s=raw.received_s,
            driver_sequence=raw.driver_sequence,
            stream=raw.stream,
            raw=raw,
        )
        self._converted = (raw, frame)
        return frame

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

    def _judge(self, stream: Stream, raw: RawFrame) -> None:
        """In the capture thread: look at a frame now and then, and set the exposure that its group wants."""
        control = self._exposure
        if control is None or stream.exposure_s is None:
            return
        if control.exposure_s == stream.asked_exposure_s and raw.window.begin_s >= self._judge_after_s:
            self._judge_after_s = raw.received_s + JUDGE_EVERY_S
            if not control.held:
                control.see(self.name, pixels.grey(raw.format, raw.raw), control.exposure_s)
        if control.exposure_s != stream.asked_exposure_s:  # also when another camera of the group wanted it
            stream.set_exposure(control.exposure_s)
            self._judge_after_s = raw.received_s + SETTLE_PERIODS * stream.period_s

    def _instead(self, exposed_after_s: float, timeout_s: float, before: Counters) -> str:
        """What to say when no fresh frame came."""
        counters = self.counters
        message = f"no frame exposed after {exposed_after_s:.3f} s came within {timeout_s:g} s"
        damaged = counters.damaged - before.damaged
        if damaged:
            message += f"; {damaged} came damaged ({counters.last_damage})"
        last = self.capture.newest
        if last is None:
            return message if damaged else f"{message}; none came at all"
        age_s = exposed_after_s - last.window.begin_s
        return f"{message}; the last good one is frame {last.sequence}, exposed {age_s:.3f} s before"
