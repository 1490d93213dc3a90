"""The driver ``aravis``: a GigE Vision or USB3 Vision camera whose frames are never older than asked for."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from drivers import pixels
from drivers.aravis.capture import GenicamCapture
from drivers.aravis.options import AravisOptions, parse_options
from drivers.clock import Clock
from drivers.errors import NoCamera, NoFreshFrame
from drivers.interfaces import Camera, CameraInfo, CameraSetting, FrameTime
from drivers.newest import Counters, TimedFrame
from drivers.registry import Driver


def open_camera(options: Mapping[str, Any], clock: Clock | None = None, name: str = "aravis") -> AravisCamera:
    """Open a camera by a configuration's options (docs/how-to/cameras.md).

    ``clock`` is not used: the camera's clock is tied to the machine's. Raises BadOptions for options that it
    refuses, and without the library Aravis; DriverError if the camera does not answer or another program has
    it.
    """
    return AravisCamera(parse_options(options, name), name)


class AravisCamera(Camera):
    """One camera; safe from any thread."""

    def __init__(self, options: AravisOptions, name: str) -> None:
        self.name = name
        self._options = options
        self.capture = GenicamCapture(options, name, pixels.colour if options.colour else pixels.grey)
        self._last: TimedFrame | None = None

    @property
    def counters(self) -> Counters:
        """The counts of good, damaged and missing frames so far."""
        return self.capture.newest.counters

    @property
    def info(self) -> CameraInfo:
        """Size and sensor mode, its period and the name of its hardware trigger."""
        capture = self.capture
        return CameraInfo(
            size_px=capture.format.size_px,
            sensor_mode=capture.sensor_mode,
            period_s=self._period_s(),
            trigger=self._options.trigger,
        )

    def _period_s(self) -> float:
        """From frame to frame, as the camera states it; of a triggered one, between its last frames."""
        if self.capture.period_s is not None:
            return self.capture.period_s
        times = self.recent_times()
        if len(times) < 2:
            return 1.0
        span_s = times[-1].exposure_began_s - times[0].exposure_began_s
        return max(1e-3, span_s / max(1, times[-1].sequence - times[0].sequence))

    def recent_times(self) -> list[FrameTime]:
        """Return the times of the last good frames of this stream, oldest first."""
        return [FrameTime(frame.sequence, frame.window.begin_s) for frame in self.capture.newest.recent()]

    def settings(self) -> list[CameraSetting]:
        """Return exposure, gain, white balance and focus, as far as it has them. Raises DriverError."""
        return self.capture.settings()

    def adjust(self, wanted: Mapping[str, float]) -> Sequence[str]:
        """Change some of them, as `drivers.interfaces.Camera.adjust`."""
        return self.capture.adjust(wanted)

    @contextmanager
    def exposure_held(self) -> Iterator[None]:
        """Wait until a change that was made before shows, for a second at most: a measurement compares
        pictures. Inside the block the exposure is as the camera's features leave it.
        """
        self.capture.await_settled()
        yield

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> TimedFrame:
        """Return the newest frame whose exposure surely began after ``exposed_after_s``, waiting if need be.

        Raises NoFreshFrame if none came within ``timeout_s`` seconds; the message says what came instead;
        NoCamera (at once, if the camera is gone).
        """
        newest = self.capture.newest
        damaged = newest.damaged
        taken = self.capture.take(exposed_after_s, timeout_s)
        if taken is None:
            if lost := newest.lost:
                raise NoCamera(lost)
            words = self.capture.newest.instead(exposed_after_s, timeout_s, damaged, time.monotonic())
            raise NoFreshFrame(words, device=self.name)
        arrived, image, _ = taken
        last = self._last
        if last is not None and last.image is image:
            return last
        window, exposure_s = arrived.window, arrived.settings.get("exposure_s")
        self._last = TimedFrame(
            image=image,
            settings=arrived.settings,
            sequence=arrived.sequence,
            mid_exposure_s=window.mid_s,
            exposure_s=window.length_s,
            mid_uncertainty_s=max(0.0, window.length_s - (exposure_s or 0.0)) / 2,
            set_exposure_s=exposure_s,
            stamp_s=arrived.filled.stamp_s,
            received_s=arrived.received_s,
            driver_sequence=arrived.filled.number,
            stream=arrived.stream,
        )
        return self._last

    def close(self) -> None:
        """Let go of the camera; a waiting call ends with NoFreshFrame."""
        self.capture.close()


DRIVER = Driver(lambda options, context: open_camera(options, context.clock, context.name))
