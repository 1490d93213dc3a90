"""The driver ``aravis``: a GigE Vision or USB3 Vision camera whose frames are never older than requested.

The camera's own clock is tied to ours by two observations that bound the difference. A *reading* (the camera
latches its clock between two moments of ours) bounds it from both sides. The *arrival* of a frame's first
packet bounds it from above alone, since no packet comes before its exposure. The least delay of the path must
then be stated (`CameraClock.least_delay_s`). Bounds widen as long as nothing new is observed, by the most
that two crystals drift apart.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, NamedTuple

from drivers import pixels
from drivers.aravis import find
from drivers.aravis.device import Device, Filled
from drivers.aravis.settings import EXPOSURE, AravisOptions, Stamped, parse_options
from drivers.clock import Clock
from drivers.errors import NoCamera, StreamFailed
from drivers.interfaces import CameraInfo, CameraSetting, Image
from drivers.newest import (
    CLOSE_PATIENCE_S,
    FIRST_PAUSE_S,
    LATE_S,
    CapturedCamera,
    ExposureWindow,
    TimedFrame,
)
from drivers.registry import CameraBench, Driver
from drivers.values_set import ValuesSet

log = logging.getLogger(__name__)

SETTLE_S = 1.0  # for a change to show
WAIT_S = 0.1  # for a frame: so long after the last one a loss or the end is looked for
SILENT_S, SILENT_PERIODS = 1.0, 5  # a free-running camera that gives nothing for so long is opened again
READ_CLOCK_EVERY_S = 1.0
LEARNING_FRAMES = 4  # where a clock cannot be read, these show how soon a frame may come
DELAYED_S, DELAYED_FRAMES = 1.0, 5  # so many frames that come so late: the camera's clock was set back
CLOSING_S = 1.0


DRIFT = 1e-4
"""100 ppm: two crystals of 50 ppm each, in opposite directions; usual ones have 20 to 50."""


class ClockStepped(Exception):
    """The camera's clock was set, or began again: nothing that was known of it holds."""


@dataclass
class CameraClock:
    """Bounds of our clock minus the camera's, seconds, of one stream; when they were last looked at, at
    ``at_s``.

    ``least_delay_s``: at its best, the path brings a frame's first packet at most so long after its stamp. It
    counts only for a camera whose clock cannot be read.
    """

    least_delay_s: float
    low_s: float = -math.inf
    high_s: float = math.inf
    at_s: float = 0.0
    readings: int = 0

    def read(self, before_s: float, camera_s: float, after_s: float) -> None:
        """Take in that the camera's clock stood at ``camera_s`` between two moments of ours.

        Raises ClockStepped if that contradicts what was observed before.
        """
        self._widen(after_s)
        low_s, high_s = before_s - camera_s, after_s - camera_s
        if self.readings:
            low_s, high_s = max(self.low_s, low_s), min(self.high_s, high_s)
        else:
            high_s = min(self.high_s, high_s)
        self.readings += 1
        self.low_s, self.high_s = low_s, high_s
        self._check()

    def arrived(self, stamp_s: float, arrived_s: float) -> None:
        """Take in that a frame stamped ``stamp_s`` by the camera began to come at ``arrived_s`` of ours.

        Raises ClockStepped if the frame came before it was stamped.
        """
        self._widen(arrived_s)
        above_s = arrived_s - stamp_s
        if above_s < self.high_s:
            self.high_s = above_s
            if not self.readings:
                self.low_s = above_s - self.least_delay_s
        self._check()

    def window(self, stamp_s: float, stamped: Stamped, longest_s: float, arrived_s: float) -> ExposureWindow:
        """Return in which stretch of our time a frame was exposed.

        At ``arrived_s`` its first packet came: the exposure was over.
        """
        begin_s = stamp_s + self.low_s - (0.0 if stamped == "start" else longest_s)
        end_s = stamp_s + self.high_s + (0.0 if stamped == "end" else longest_s)
        return ExposureWindow(begin_s, max(begin_s, min(end_s, arrived_s)))

    def _widen(self, now_s: float) -> None:
        """Let the bounds grow by what the clocks may have drifted apart."""
        by_s = DRIFT * max(0.0, now_s - self.at_s) if self.at_s else 0.0
        self.low_s -= by_s
        self.high_s += by_s
        self.at_s = max(self.at_s, now_s)

    def _check(self) -> None:
        if self.low_s > self.high_s:
            raise ClockStepped(f"the camera's clock was set: it is off by {self.low_s - self.high_s:.3g} s")


class ArrivedGenicam(NamedTuple):
    """A good frame, without its picture; the whole exposure lay in its window.

    ``sequence`` is our own count, which grows over every reopening; a setting that is not known of it is
    None.
    """

    filled: Filled
    window: ExposureWindow
    settings: Mapping[str, float | None]
    sequence: int
    stream: int
    received_s: float


def open_camera(options: Mapping[str, Any], clock: Clock | None = None, name: str = "aravis") -> AravisCamera:
    """Open a camera by a configuration's options (docs/how-to/cameras.md).

    ``clock`` is not used: the camera's clock is tied to the machine's. Raises BadOptions for options that it
    refuses, and without the library Aravis; DriverError if the camera does not answer or another program has
    it.
    """
    return AravisCamera(parse_options(options, name), name)


class AravisCamera(CapturedCamera[ArrivedGenicam]):
    """One camera, as `CapturedCamera`."""

    def __init__(self, options: AravisOptions, name: str) -> None:
        super().__init__(name)
        self._options = options
        self._convert = pixels.colour if options.colour else pixels.grey
        self._adjusted: dict[str, float] = {}
        self._longest_s: float  # of an exposure that is not known
        self._clock: CameraClock
        self._streams = 0
        self._last_sequence = -1
        self._last_number: int | None = None
        self._kept_buffer: int | None = None
        self._delayed = 0
        self._device: Device | None = None
        device = self._open()
        self.format, self.period_s = device.format, device.period_s
        self.sensor_mode = device.sensor_mode
        self.problems, self.camera_name = tuple(device.problems), device.camera_name
        self._begin(device)

    @property
    def info(self) -> CameraInfo:
        """Size and sensor mode, its period and the name of its hardware trigger."""
        return CameraInfo(
            size_px=self.format.size_px,
            sensor_mode=self.sensor_mode,
            period_s=self._period_s(),
            trigger=self._options.trigger,
        )

    def _period_s(self) -> float:
        """From frame to frame, as the camera states it; of a triggered one, between its last frames."""
        if self.period_s is not None:
            return self.period_s
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
        if self._options.free_running:
            self.await_settled(SETTLE_S)
        yield

    def _timed(self, arrived: ArrivedGenicam, image: Image, jpeg: bytes) -> TimedFrame:
        window, exposure_s = arrived.window, arrived.settings.get("exposure_s")
        return TimedFrame(
            image=image,
            settings=arrived.settings,
            sequence=arrived.sequence,
            mid_exposure_s=window.mid_s,
            exposure_s=window.length_s,
            mid_uncertainty_s=window.mid_uncertainty_s(exposure_s),
            set_exposure_s=exposure_s,
            stamp_s=arrived.filled.stamp_s,
            received_s=arrived.received_s,
            driver_sequence=arrived.filled.number,
            stream=arrived.stream,
        )

    def _is_young(self, frame: ArrivedGenicam) -> bool:
        """Whether no newer one should be here: a triggered camera's stays young."""
        if self.period_s is None or not self._options.free_running:
            return True
        return time.monotonic() - frame.received_s <= self.period_s + LATE_S

    def settings(self) -> list[CameraSetting]:
        """Return what may be changed, as the camera has it now. Raises DriverError."""
        return self._there().settings()

    def adjust(self, wanted: Mapping[str, float]) -> Sequence[str]:
        """Change settings; a stream that is opened later has them too. Raises BadSetting, DriverError."""
        self._there()
        with self._opening:
            device = self._there()
            self._allow(wanted.get(EXPOSURE.name, 0.0))
            became, notes, refused = device.change(wanted, self._in_force)
            self._adjusted |= became
            self._allow(became.get(EXPOSURE.name, 0.0))
        if refused is not None:
            raise refused
        return notes

    def _there(self) -> Device:
        """The camera that streams. Raises NoCamera if it is gone."""
        device = self._device
        if device is None or self.lost:
            raise NoCamera(self.lost or f"{self.name}: it is being opened again")
        return device

    def _allow(self, exposure_s: float) -> None:
        """Take in that exposures may become so long."""
        self._longest_s = max(self._longest_s, exposure_s)
        self._clock.least_delay_s = self._least_delay_s()

    def _least_delay_s(self) -> float:
        """How late the quickest frame's first packet comes after its stamp, at most."""
        return self._options.margin_s + (0.0 if self._options.stamp == "end" else self._longest_s)

    # In the capture thread

    def _let_go(self, device: Device) -> None:
        """Close a stream before it is opened again; wait only a second for a camera that is gone."""
        self._device = None
        self._kept_buffer = None
        closing = threading.Thread(target=device.close, name=f"closing {self.name}", daemon=True)
        closing.start()
        closing.join(CLOSE_PATIENCE_S if self._over.is_set() else CLOSING_S)

    def _open(self) -> Device:
        with self._opening:
            device = Device(self._options, self.name, self._adjusted)
            if self._streams and device.sensor_mode != self.sensor_mode:
                device.close()
                message = f"it came back with {device.sensor_mode} where it had {self.sensor_mode}"
                raise StreamFailed(message, device=self.name)
            self._longest_s = device.values.get(EXPOSURE.name) or device.period_s or 1.0
            self._clock = CameraClock(self._least_delay_s())
            self._in_force = {name: ValuesSet(value) for name, value in device.values.items()}
        self._device = device
        self._streams += 1
        self._last_number, self._delayed, self._learned = None, 0, 0
        return device

    def _stream(self, device: Device) -> None:
        """Take frames until closed. Raises DriverError when the camera fails."""
        heard_s = time.monotonic()
        silent_s = max(SILENT_S, SILENT_PERIODS * (device.period_s or 0.0))
        read_next_s = self._read_clock(device, heard_s)
        while not self._over.is_set():
            filled = device.wait(WAIT_S)
            now_s = time.monotonic()
            if device.lost.is_set():
                message = "it no longer answers: unplugged, without power, or taken over"
                raise NoCamera(message, device=self.name)
            if filled is not None:
                heard_s = now_s
                self._take(device, filled, now_s)
                if now_s >= read_next_s:
                    read_next_s = self._read_clock(device, now_s)
                continue
            if self._options.free_running and now_s - heard_s > silent_s:
                raise StreamFailed(
                    f"it gave no frame for {now_s - heard_s:.1f} s (its cable, its power?)",
                    device=self.name,
                )

    def _read_clock(self, device: Device, now_s: float) -> float:
        """Read the camera's clock, where it can be; return when to do it next."""
        if (reading := device.read_clock()) is None:
            return math.inf
        try:
            self._clock.read(*reading)
        except ClockStepped as error:
            raise StreamFailed(str(error), device=self.name) from None
        return now_s + READ_CLOCK_EVERY_S

    def _take(self, device: Device, filled: Filled, received_s: float) -> None:
        """Check one buffer; publish it if it is good, and give the last one back, else itself."""
        dropped = self._count(filled)
        wrong = filled.wrong
        if not wrong:
            try:
                self._clock.arrived(filled.stamp_s, filled.arrived_s)
            except ClockStepped as error:
                raise StreamFailed(str(error), device=self.name) from None
            wrong = self._wrong_delay(filled)
        self._learned += not wrong
        learning = not self._clock.readings and self._learned <= LEARNING_FRAMES
        if wrong or learning:
            self._refuse(dropped, wrong)
            device.queue(filled.handle)
            return
        window = self._window(filled, self._longest_s)
        settings: dict[str, float | None] = {}
        for name, values in self._in_force.items():
            settings[name], highest = values.of(self._last_sequence, window.end_s, window.begin_s)
            if name == EXPOSURE.name and highest is not None:
                window = self._window(filled, highest)
        settings |= filled.sent
        if sent_s := filled.sent.get(EXPOSURE.name):
            window = self._window(filled, sent_s)
        frame = ArrivedGenicam(filled, window, settings, self._last_sequence, self._streams, received_s)
        self._publish(frame, partial(self._made, device, filled.handle), dropped=dropped, late=False)
        previous, self._kept_buffer = self._kept_buffer, filled.handle
        if previous is not None:
            device.queue(previous)
        self._pause_s = FIRST_PAUSE_S

    def _window(self, filled: Filled, longest_s: float) -> ExposureWindow:
        """In which stretch of our time a frame was exposed, for so long at most."""
        return self._clock.window(filled.stamp_s, self._options.stamp, longest_s, filled.arrived_s)

    def _made(self, device: Device, handle: int) -> tuple[Image, bytes]:
        """The picture of a buffer."""
        data, format = device.bytes_of(handle)
        return self._convert(format, data), b""

    def _count(self, filled: Filled) -> int:
        """Count a frame; return how many are missing before it, as far as its number says."""
        step = 1
        if self._last_number is not None:
            step = filled.number - self._last_number
            if step <= 0 and self._last_number < 2**16:
                step += 2**16 - 1  # the count of 16 bits leaves out 0
            if not 0 < step < 2**15:  # it began again: nothing says how many that cost
                step = 1
        self._last_number = filled.number
        self._last_sequence += step
        return step - 1

    def _wrong_delay(self, filled: Filled) -> str:
        """Why a frame comes too late to be believed; empty if it does not. Raises StreamFailed for many."""
        delay_s = filled.arrived_s - filled.stamp_s - self._clock.high_s
        if delay_s <= DELAYED_S + self._longest_s:
            self._delayed = 0
            return ""
        self._delayed += 1
        message = f"it came {delay_s:.3g} s later after its stamp than others"
        if self._delayed >= DELAYED_FRAMES:
            raise StreamFailed(f"{message}, as {self._delayed} before; was its clock set?", device=self.name)
        return message


DRIVER = Driver(
    lambda options, context: open_camera(options, context.clock, context.name),
    probe=find.probe, probe_order=1, bench=CameraBench(
        "genicam", "cameras of GigE Vision and USB3 Vision (driver aravis)",
        lambda: ([asdict(one) for one in find.list_cameras()], []), find.present,
    ),
)  # fmt: skip
