"""The driver ``aravis``: a GigE Vision or USB3 Vision camera whose frames are never older than asked for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

from drivers import pixels
from drivers.aravis import find
from drivers.aravis.capture import ArrivedGenicam, GenicamCapture
from drivers.aravis.options import AravisOptions, parse_options
from drivers.clock import Clock
from drivers.interfaces import CameraInfo, Image
from drivers.newest import CapturedCamera, TimedFrame
from drivers.probes import CameraBench
from drivers.registry import Driver


def open_camera(options: Mapping[str, Any], clock: Clock | None = None, name: str = "aravis") -> AravisCamera:
    """Open a camera by a configuration's options (docs/how-to/cameras.md).

    ``clock`` is not used: the camera's clock is tied to the machine's. Raises BadOptions for options that it
    refuses, and without the library Aravis; DriverError if the camera does not answer or another program has
    it.
    """
    return AravisCamera(parse_options(options, name), name)


class AravisCamera(CapturedCamera):
    """One camera; safe from any thread."""

    capture: GenicamCapture

    def __init__(self, options: AravisOptions, name: str) -> None:
        self.name = name
        self._options = options
        self.capture = GenicamCapture(options, name, pixels.colour if options.colour else pixels.grey)

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

    @contextmanager
    def exposure_held(self) -> Iterator[None]:
        """Wait until a change that was made before shows, for a second at most: a measurement compares
        pictures. Inside the block the exposure is as the camera's features leave it.
        """
        self.capture.await_settled()
        yield

    def _timed(self, arrived: ArrivedGenicam, image: Image, jpeg: bytes) -> TimedFrame:
        window, exposure_s = arrived.window, arrived.settings.get("exposure_s")
        return TimedFrame(
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

    def close(self) -> None:
        """Let go of the camera; a waiting call ends with NoFreshFrame."""
        self.capture.close()


DRIVER = Driver(
    lambda options, context: open_camera(options, context.clock, context.name),
    probe=find.probe, probe_order=1, bench=CameraBench(
        "genicam", "cameras of GigE Vision and USB3 Vision (driver aravis)",
        lambda: ([asdict(one) for one in find.list_cameras()], []), find.present,
    ),
)  # fmt: skip
