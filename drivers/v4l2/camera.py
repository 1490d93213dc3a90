"""The driver ``v4l2``: a camera whose frames are never older than asked for (`drivers.interfaces.Camera`)."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from drivers import pixels
from drivers.clock import Clock, SystemClock
from drivers.errors import StreamFailed, UnsupportedFormat
from drivers.interfaces import CameraInfo, Image
from drivers.newest import CapturedCamera, TimedFrame
from drivers.probes import CameraBench
from drivers.registry import Driver
from drivers.v4l2 import find
from drivers.v4l2.capture import Bytes, Capture
from drivers.v4l2.controls import get_value, list_controls
from drivers.v4l2.exposure import GROUPS, ExposureControl
from drivers.v4l2.options import CameraOptions, parse_options
from drivers.v4l2.stamps import Arrived
from drivers.v4l2.stream import Stream, sizes_text

JUDGE_EVERY_S = 0.25  # how often the automatic exposure looks at a frame
HOLD_PERIODS = 8  # so long a hold waits for a change under way to show: it takes three frames once it is made
HOLD_MOST_S = 1.0


def open_camera(options: Mapping[str, Any], clock: Clock | None = None, name: str = "v4l2") -> V4l2Camera:
    """Open a camera by a configuration's options (docs/how-to/cameras.md).

    Raises BadOptions for options that it refuses; UnsupportedFormat and NotACamera are of this kind;
    DriverError if the camera is not connected, busy, or not to be opened by this user.
    """
    return V4l2Camera(parse_options(options, name), name, clock or SystemClock())


class V4l2Camera(CapturedCamera):
    """One camera; safe from any thread."""

    capture: Capture

    def __init__(self, options: CameraOptions, name: str, clock: Clock) -> None:
        self.name = name
        self._options = options
        self._clock = clock
        self._exposure: ExposureControl | None = None
        self._judge_after_s = 0.0
        self._exposed = threading.Condition()  # guards what follows
        self._holds = 0
        self._asked_s: float | None = None  # the exposure time that was set last, as it was asked for
        self._shows = False  # whether the last frame had it
        self._changing = False
        if options.auto_exposure is not None and options.exposure_s is not None:
            self._exposure = GROUPS.join(name, options.auto_exposure, options.exposure_s)
        try:
            self.capture = Capture(
                options,
                name,
                clock,
                pixels.colour if options.colour else pixels.grey,
                None if self._exposure is None else self._judge,
                None if self._exposure is None else self._to_open_with_s,
            )
        except BaseException:
            self._leave_group()
            raise

    @property
    def info(self) -> CameraInfo:
        """Size, sensor mode and period as its driver reports them, and the configured trigger."""
        capture = self.capture
        return CameraInfo(
            size_px=capture.format.size_px,
            sensor_mode=capture.sensor_mode,
            period_s=capture.period_s,
            trigger=self._options.trigger,
        )

    def _timed(self, arrived: Arrived, image: Image, jpeg: bytes) -> TimedFrame:
        buffer, window, exposure_s = arrived.buffer, arrived.window, arrived.timing.exposure_s
        return TimedFrame(
            image=image,
            jpeg=jpeg,
            settings=arrived.settings,
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

    def now_s(self) -> float:
        """Return the time by the clock that its stamps are judged by."""
        return self._clock.now_s()

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
        """Keep the exposure as it is inside the block: for a measurement that compares pictures.

        A change that this camera's group decided on before is first made, and waited for until it shows, for
        eight periods (1 s) at most. What was not made by then is made after the block. A change of settings
        that was made before is waited for likewise. Raises StreamFailed if the camera is still at such a
        change after that time: nobody could say when it takes effect.
        """
        control = self._exposure
        if control is None:
            self._await_settings()
            yield
            return
        control.hold()
        try:
            self._await_settings()
            self._await_change(control)
            try:
                yield
            finally:
                with self._exposed:
                    self._holds -= 1
        finally:
            control.release()

    def _await_settings(self) -> None:
        """Wait until what was set before a hold shows."""
        self.capture.await_settled(min(HOLD_MOST_S, HOLD_PERIODS * self.capture.period_s))

    def _await_change(self, control: ExposureControl) -> None:
        """Count a hold in, once the exposure is the group's and shows, or no frame comes to say so."""

        def rests() -> bool:
            return bool(self.capture.lost) or (self._shows and self._asked_s == control.exposure_s)

        with self._exposed:
            if not self._holds:
                self._exposed.wait_for(rests, min(HOLD_MOST_S, HOLD_PERIODS * self.capture.period_s))
            if self._changing:
                raise StreamFailed(
                    "it is still at a change of its exposure time and cannot hold it", device=self.name
                )
            self._holds += 1

    def close(self) -> None:
        """Let go of the camera; a waiting call ends with NoFreshFrame."""
        self.capture.close()
        self._leave_group()

    def _to_open_with_s(self) -> float:
        """The exposure time to open with; while it is held, that of before."""
        control = self._exposure
        assert control is not None
        with self._exposed:
            held_s = self._asked_s if self._holds else None
        return control.exposure_s if held_s is None else held_s

    def _leave_group(self) -> None:
        if self._exposure is not None and self._options.auto_exposure is not None:
            self._exposure = None
            GROUPS.leave(self.name, self._options.auto_exposure)

    def _judge(self, stream: Stream, frame: Arrived, data: Bytes) -> None:
        """In the capture thread: look at a frame now and then, and set the exposure that its group wants."""
        control = self._exposure
        if control is None:
            return
        with self._exposed:
            self._asked_s = stream.asked_exposure_s
            self._shows = frame.timing.exposure_s == stream.exposure_s
            shows = self._shows
            self._exposed.notify_all()
        if stream.exposure_s is None:
            return
        wanted_s = control.exposure_s
        if wanted_s == stream.asked_exposure_s and shows and frame.received_s >= self._judge_after_s:
            self._judge_after_s = frame.received_s + JUDGE_EVERY_S
            if not control.is_fixed:
                wanted_s = control.see(self.name, pixels.grey(frame.format, data), wanted_s)
        if wanted_s != stream.asked_exposure_s:  # also when another camera of the group wanted it
            self._change(stream, wanted_s)

    def _change(self, stream: Stream, exposure_s: float) -> None:
        """Set the exposure, unless it is held; not under the lock, since a camera may take long over it."""
        with self._exposed:
            if self._holds:
                return
            self._changing, self._shows = True, False
        try:
            stream.set_exposure(exposure_s)
        finally:
            with self._exposed:
                self._changing, self._asked_s = False, stream.asked_exposure_s


def present(options: Mapping[str, Any], name: str) -> str:
    """Return which camera a configuration names, as `drivers.probes.CameraBench`. Raises DriverError."""
    wanted = parse_options(options, name)
    with find.open_node(wanted.address, name) as node:
        offered, place = node.formats(), f"{node.identity.card} at {node.identity.bus}"
    if wanted.format not in offered:
        words = (
            f"{place} offers {', '.join(offered)} where {wanted.format} is configured; configure one of these"
        )
        raise UnsupportedFormat(words, device=name)
    return f"{place}, {wanted.format}"


DRIVER = Driver(
    lambda options, context: open_camera(options, context.clock, context.name),
    probe=find.probe, bench=CameraBench("cameras", "cameras", find.table, present, find.options_for),
)  # fmt: skip
