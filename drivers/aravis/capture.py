"""The thread of one camera: takes and checks every frame, keeps the newest good one, reopens what went."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.aravis.camera_clock import CameraClock, ClockStepped, GenicamWindow
from drivers.aravis.device import Device, Filled
from drivers.aravis.options import AravisOptions
from drivers.aravis.settings import EXPOSURE
from drivers.errors import DriverError, NoCamera, StreamFailed
from drivers.interfaces import CameraSetting, Image
from drivers.newest import Newest
from drivers.pixels import PictureFormat
from drivers.values_set import ValuesSet

log = logging.getLogger(__name__)

WAIT_S = 0.1  # for a frame: so long after the last one a loss or the end is looked for
SILENT_S, SILENT_PERIODS = 1.0, 5  # a free-running camera that gives nothing for so long is opened again
READ_CLOCK_EVERY_S = 1.0
LEARNING_FRAMES = 4  # where a clock cannot be read, these show how soon a frame may come
DELAYED_S, DELAYED_FRAMES = 1.0, 5  # so many frames that come so late: the camera's clock was set back
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.05, 1.0  # between tries to open a camera that is there and fails
CLOSE_PATIENCE_S, CLOSING_S = 2.0, 1.0
LATE_S = 0.005
SETTLE_S = 1.0

Convert = Callable[[PictureFormat, NDArray[np.uint8]], Image]


class ArrivedGenicam(NamedTuple):
    """A good frame, without its picture.

    Attributes
    ----------
    filled, window
        The buffer with the camera's own count and stamp, and in which the whole exposure lay.
    settings
        Those of this frame, by name: as it came with them, else as they were set; None for what is not known.
    sequence, stream
        Our own count, which grows over every reopening, and the number of the stream.
    received_s
        When it was whole, seconds of CLOCK_MONOTONIC.
    """

    filled: Filled
    window: GenicamWindow
    settings: Mapping[str, float | None]
    sequence: int
    stream: int
    received_s: float


class GenicamCapture:
    """Streams from one camera until it is closed; safe from any thread.

    Raises
    ------
    DriverError
        If the camera cannot be opened now. Once it was, it is opened again whenever it comes back.
    """

    def __init__(self, options: AravisOptions, name: str, convert: Convert) -> None:
        self._options, self._name, self._convert = options, name, convert
        self.newest: Newest[ArrivedGenicam] = Newest()
        self._over = threading.Event()
        self._opening = threading.Lock()  # guards what is adjusted, and which values are in force
        self._adjusted: dict[str, float] = {}
        self._longest_s: float  # of an exposure that is not known
        self._clock: CameraClock
        self._streams = 0
        self._last_sequence = -1
        self._last_number: int | None = None
        self._kept_buffer: int | None = None
        self._delayed = 0
        self._pause_s = FIRST_PAUSE_S
        self._device: Device | None = self._open()
        self.format, self.period_s = self._device.format, self._device.period_s
        self.sensor_mode = self._device.sensor_mode
        self.problems, self.words = tuple(self._device.problems), self._device.words
        self._thread = threading.Thread(
            target=self._serve, args=(self._device,), name=f"capture {name}", daemon=True
        )
        self._thread.start()

    def take(self, exposed_after_s: float, timeout_s: float) -> tuple[ArrivedGenicam, Image, bytes] | None:
        """Return the newest frame exposed after that moment, as `drivers.newest.Newest.take`."""
        return self.newest.take(exposed_after_s, timeout_s, self._is_young)

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

    def await_settled(self) -> None:
        """Wait until a frame came that shows no setting of before, for a second at most."""
        if self._options.free_running:
            in_force = self._in_force
            self.newest.wait_until(lambda: all(one.settled for one in in_force.values()), SETTLE_S)

    def _there(self) -> Device:
        """The camera that streams. Raises NoCamera if it is gone."""
        device = self._device
        if device is None or self.newest.lost:
            raise NoCamera(self.newest.lost or f"{self._name}: it is being opened again")
        return device

    def _allow(self, exposure_s: float) -> None:
        """Take in that exposures may become so long."""
        self._longest_s = max(self._longest_s, exposure_s)
        self._clock.least_delay_s = self._least_delay_s()

    def _least_delay_s(self) -> float:
        """How late the quickest frame's first packet comes after its stamp, at most."""
        return self._options.margin_s + (0.0 if self._options.stamp == "end" else self._longest_s)

    def close(self) -> None:
        """End the thread and let go of the camera; one that is gone is left behind after 2 s."""
        if not self.newest.close():
            return
        self._over.set()
        self._thread.join(CLOSE_PATIENCE_S)
        if self._thread.is_alive():
            log.warning("%s: it does not answer; Aravis lets go of it when it gives up", self._name)

    # In the capture thread

    def _serve(self, device: Device | None) -> None:
        """Stream, and open again after every failure, until closed."""
        while True:
            if device is not None:
                try:
                    self._stream(device)
                    return
                except DriverError as error:
                    self._lose(str(error))
                except Exception as error:  # a defect here must not end in a thread that is silently gone
                    log.exception("%s: the capture failed", self._name)
                    self._lose(f"{self._name}: the capture failed: {type(error).__name__}: {error}")
                finally:
                    self._let_go(device)
            if self._over.wait(self._pause_s):
                return
            self._pause_s = min(2 * self._pause_s, LONGEST_PAUSE_S)
            device = self._reopened()

    def _lose(self, why: str) -> None:
        if self.newest.lose(why):
            log.warning("%s; it is opened again when it is back", why)

    def _let_go(self, device: Device) -> None:
        """Close a stream before it is opened again; wait only a second for a camera that is gone."""
        self._device = None
        self.newest.forget()
        self._kept_buffer = None
        closing = threading.Thread(target=device.close, name=f"closing {self._name}", daemon=True)
        closing.start()
        closing.join(CLOSE_PATIENCE_S if self._over.is_set() else CLOSING_S)

    def _reopened(self) -> Device | None:
        """Try to open the camera again; None if it is not back."""
        try:
            device = self._open()
        except Exception as error:
            if not isinstance(error, DriverError):
                log.exception("%s: opening again failed", self._name)
            self.newest.lose(str(error) or type(error).__name__)
            return None
        self._device = device
        self.newest.come_back()
        log.warning("%s is back", self._name)
        return device

    def _open(self) -> Device:
        with self._opening:
            device = Device(self._options, self._name, self._adjusted)
            if self._streams and device.sensor_mode != self.sensor_mode:
                device.close()
                words = f"it came back with {device.sensor_mode} where it had {self.sensor_mode}"
                raise StreamFailed(words, device=self._name)
            self._longest_s = device.values.get(EXPOSURE.name) or device.period_s or 1.0
            self._clock = CameraClock(self._least_delay_s())
            self._in_force = {name: ValuesSet(value) for name, value in device.values.items()}
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
                words = "it no longer answers: unplugged, without power, or taken over"
                raise NoCamera(words, device=self._name)
            if filled is not None:
                heard_s = now_s
                self._take(device, filled, now_s)
                if now_s >= read_next_s:
                    read_next_s = self._read_clock(device, now_s)
                continue
            if self._options.free_running and now_s - heard_s > silent_s:
                raise StreamFailed(
                    f"it gave no frame for {now_s - heard_s:.1f} s (its cable, its power?)",
                    device=self._name,
                )

    def _read_clock(self, device: Device, now_s: float) -> float:
        """Read the camera's clock, where it can be; return when to do it next."""
        if (reading := device.read_clock()) is None:
            return math.inf
        try:
            self._clock.read(*reading)
        except ClockStepped as error:
            raise StreamFailed(str(error), device=self._name) from None
        return now_s + READ_CLOCK_EVERY_S

    def _take(self, device: Device, filled: Filled, received_s: float) -> None:
        """Check one buffer; publish it if it is good, and give the last one back, else itself."""
        dropped = self._count(filled)
        wrong = filled.wrong
        if not wrong:
            try:
                self._clock.arrived(filled.stamp_s, filled.arrived_s)
            except ClockStepped as error:
                raise StreamFailed(str(error), device=self._name) from None
            wrong = self._wrong_delay(filled)
        self._learned += not wrong
        learning = not self._clock.readings and self._learned <= LEARNING_FRAMES
        if wrong or learning:
            self.newest.refuse(dropped, wrong)
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
        self.newest.publish(frame, partial(self._made, device, filled.handle), dropped=dropped, late=False)
        previous, self._kept_buffer = self._kept_buffer, filled.handle
        if previous is not None:
            device.queue(previous)
        self._pause_s = FIRST_PAUSE_S

    def _window(self, filled: Filled, longest_s: float) -> GenicamWindow:
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
        words = f"it came {delay_s:.3g} s later after its stamp than others"
        if self._delayed >= DELAYED_FRAMES:
            raise StreamFailed(f"{words}, as {self._delayed} before; was its clock set?", device=self._name)
        return words
