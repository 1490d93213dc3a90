"""One opened camera: its features set as requested and checked, its buffers, and its clock read."""

from __future__ import annotations

import ctypes
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.geometry.mode import SensorMode
from drivers.aravis import find
from drivers.aravis.library import CONTROL_LOST, GenicamError, library
from drivers.aravis.settings import (
    EXPOSURE,
    MEANINGS,
    AravisOptions,
    Control,
    Feature,
    change,
    set_up,
    settings_of,
)
from drivers.errors import CameraBusy, DriverError, NoCamera, StreamFailed, UnsupportedFormat
from drivers.interfaces import CameraSetting
from drivers.pixels import GENICAM, PictureFormat
from drivers.values_set import SAME, ValuesSet

log = logging.getLogger(__name__)

RATE_TOLERANCE = 0.02
_CONTINUOUS = 0  # ARV_ACQUISITION_MODE_CONTINUOUS
# SFNC: the device's clock, and before SFNC 2.2 that of GigE Vision cameras, which is deprecated there.
_LATCHES = (("TimestampLatch", "TimestampLatchValue"), ("GevTimestampControlLatch", "GevTimestampValue"))
_TICKS = "GevTimestampTickFrequency"

STATUS = {
    1: "it was not filled",
    2: "not all of its packets came in time",
    3: "packets of it were lost",
    4: "a packet of it has a wrong number",
    5: "it does not fit its buffer",
    7: "its filling was broken off",
    8: "it is no image",
}
"""Meanings of ArvBufferStatus, for a frame that is not whole."""


class Filled(NamedTuple):
    """A buffer that came back, still ours until it is queued again.

    ``number`` is the camera's count: 16 bits that leave out 0, or 64 bits. ``stamp_s`` is of its own clock,
    ``arrived_s`` when its first packet came by CLOCK_MONOTONIC. ``sent`` came with it (chunk data).
    """

    handle: int
    wrong: str
    number: int
    stamp_s: float
    arrived_s: float
    sent: Mapping[str, float]


PACKET_SOCKET_DISABLED = 1
"""ARV_GV_STREAM_OPTION_PACKET_SOCKET_DISABLED. For a program that may have packet sockets (root) Aravis opens
one per stream and filters it later. Until then it hears every camera of the network: in 8 of 360 openings
beside another camera's stream it gave that camera's frame."""


SET_S = 1e-3
"""The wall's clock was set if it moved by more against CLOCK_MONOTONIC between two frames; time servers slew
by 500 ppm at most."""


LATEST_S = 1.0
"""No frame waits longer in Aravis before it is taken."""


@dataclass
class WallClock:
    """How long ago Aravis stamped a frame's first packet; it stamps by the wall's clock, which can be set."""

    _offsets_s: deque[float] = field(default_factory=lambda: deque(maxlen=8))

    def ago_s(self, stamped_s: float, wall_s: float, now_s: float) -> float:
        """Return how long before ``now_s`` (CLOCK_MONOTONIC) it was, at most; both clocks were read at once.

        0 where the wall's clock was set in the last eight frames: the frame came by now, no more is known.
        """
        offset_s = wall_s - now_s
        same = bool(self._offsets_s) and all(abs(offset_s - was_s) <= SET_S for was_s in self._offsets_s)
        self._offsets_s.append(offset_s)
        return min(max(0.0, wall_s - stamped_s), LATEST_S) if same else 0.0


class Device:
    """A camera that streams. Closing it gives everything back.

    ``period_s`` is None of a triggered camera. ``values`` are its settings at the opening, None for one that
    its automatic sets. ``lost`` is set when it no longer obeys: it was unplugged, or another program took it.
    Raises UnsupportedFormat if format, size or rate are not to be had; the message says what is; DriverError
    if the camera cannot be opened or does not start.
    """

    def __init__(self, options: AravisOptions, name: str, adjusted: Mapping[str, float]) -> None:
        self._arv = library(name)
        self._options, self._name, self._adjusted = options, name, adjusted
        self._feature_lock = threading.Lock()  # Aravis's features are not made for several threads
        self.lost = threading.Event()
        self.problems: list[str] = []
        self._wall = WallClock()
        self._parser: int | None = None
        self._chunks: list[Feature] = []
        self._longest_s, self._chunk_warned = math.inf, False
        self._stream: int | None = None
        self._latch: tuple[str, str] | None = None
        self._control_lost = CONTROL_LOST(
            lambda device, data: self.lost.set()
        )  # kept as long as it may be called
        self._camera: int = find.open_camera(options, name)
        try:
            self._arv.on_control_lost(self._arv("camera_get_device", self._camera), self._control_lost)
            self._is_gige = bool(self._arv("camera_is_gv_device", self._camera))
            self._set_up()
            self._begin()
        except GenicamError as error:
            self.close()
            raise self._opening_error(error) from None
        except BaseException:
            self.close()
            raise

    def _set_up(self) -> None:
        """Set everything that is requested, and check the answers."""
        arv, camera, options = self._arv, self._camera, self._options
        device = arv("camera_get_device", camera)
        for name, value in options.features.items():
            text = str(value).lower() if isinstance(value, bool) else str(value)
            try:
                arv("device_set_features_from_string", device, f"{name}={text}")
            except GenicamError as error:
                self.problems.append(f"feature {name} is not set to {text}: {error}")
        arv("camera_set_acquisition_mode", camera, _CONTINUOUS)
        self._set_format()
        self._set_region()
        self.period_s = self._set_pace()
        by_options = {"exposure_s": options.exposure_s, "gain": options.gain}
        wanted = {name: value for name, value in by_options.items() if value is not None}
        self.values, others = set_up(arv, camera, {**wanted, **self._adjusted})
        self.problems += others
        self._request_chunks()
        self._find_latch()
        self.sensor_mode = self._sensor_mode()
        for problem in self.problems:
            log.warning("%s: %s", self._name, problem)

    def _set_format(self) -> None:
        code = self._options.format
        offered = self._arv.texts("camera_dup_available_pixel_formats_as_strings", self._camera)
        if code not in offered:
            read = ", ".join(one for one in offered if one in GENICAM) or "none that this driver reads"
            raise UnsupportedFormat(f"the camera has no format {code}; it has {read}", device=self._name)
        self._arv("camera_set_pixel_format_from_string", self._camera, code)

    def _set_region(self) -> None:
        """Set size and offset, and check what the camera made of them."""
        arv, camera, options = self._arv, self._camera, self._options
        requested = (*options.offset_px, *options.size_px)
        bounds = {side: self._bounds(f"camera_get_{side}_bounds") for side in ("width", "height")}
        offered = " and ".join(f"{side} {low} to {high}" for side, (low, high) in bounds.items())
        sentence = (
            f"the camera does not take {requested[2]}x{requested[3]} px at ({requested[0]}, {requested[1]})"
        )
        # Aravis writes what it is given, and not every camera refuses what it cannot do.
        for side, (low, high) in zip(options.size_px, bounds.values(), strict=True):
            if not low <= side <= high:
                raise UnsupportedFormat(f"{sentence}; it has {offered}", device=self._name)
        got = [ctypes.c_int() for _ in range(4)]
        reason = ""
        try:
            arv("camera_set_region", camera, *requested)
        except GenicamError as error:
            reason = f" ({error})"
        arv("camera_get_region", camera, *(ctypes.byref(one) for one in got))
        x, y, width, height = (one.value for one in got)
        if (x, y, width, height) != requested:
            made = f"it made {width}x{height} at ({x}, {y}) of it"
            raise UnsupportedFormat(f"{sentence}{reason}; {made} and has {offered}", device=self._name)

    def _sensor_mode(self) -> SensorMode:
        """Which pixels of the sensor frames show. Region and offset count binned pixels (GenICam SFNC)."""
        arv, camera = self._arv, self._camera

        def value(kind: str, feature: str, usual: int) -> int:
            there = arv("camera_is_feature_available", camera, feature)
            return int(arv(f"camera_get_{kind}", camera, feature)) if there else usual

        size_px, region = self._options.size_px, (*self._options.offset_px, *self._options.size_px)
        flip = False, False
        try:
            flip = bool(value("boolean", "ReverseX", 0)), bool(value("boolean", "ReverseY", 0))
            sensor = value("integer", "SensorWidth", 0), value("integer", "SensorHeight", 0)
            across, down = (
                value("integer", f"Binning{side}", 1) * value("integer", f"Decimation{side}", 1)
                for side in ("Horizontal", "Vertical")
            )
            if all(sensor):
                crop = region[0] * across, region[1] * down, region[2] * across, region[3] * down
                return SensorMode(size_px, crop, sensor, flip)
        except (GenicamError, ValueError) as error:
            log.info("%s: which part of its sensor is read is not known: %s", self._name, error)
        return SensorMode(size_px, flip=flip)

    def _bounds(self, name: str) -> tuple[int, int]:
        low, high = ctypes.c_int(), ctypes.c_int()
        self._arv(name, self._camera, ctypes.byref(low), ctypes.byref(high))
        return low.value, high.value

    def _set_pace(self) -> float | None:
        """Set rate or trigger; return the period of a free-running camera, None where there is none."""
        arv, camera, options = self._arv, self._camera, self._options
        if not options.free_running:
            try:
                arv("camera_set_trigger", camera, options.trigger_source)
            except GenicamError as error:
                offered = ", ".join(arv.texts("camera_dup_available_trigger_sources", camera)) or "none"
                raise UnsupportedFormat(
                    f"the camera has no trigger source {options.trigger_source} ({error}); it has {offered}",
                    device=self._name,
                ) from None
            return None
        arv("camera_clear_triggers", camera)
        if not arv("camera_is_frame_rate_available", camera):
            return None if options.rate_hz is None else 1 / options.rate_hz
        if options.rate_hz is not None:
            arv("camera_set_frame_rate", camera, options.rate_hz)
        rate_hz: float = arv("camera_get_frame_rate", camera)
        if options.rate_hz is not None and abs(rate_hz - options.rate_hz) > RATE_TOLERANCE * options.rate_hz:
            raise UnsupportedFormat(
                f"the camera has no {options.rate_hz:g} Hz here; its nearest is {rate_hz:.4g}",
                device=self._name,
            )
        return 1 / rate_hz if rate_hz > 0 else None

    def _request_chunks(self) -> None:
        """Have each frame bring its own exposure time and gain, where the camera can."""
        arv, camera = self._arv, self._camera
        if "ChunkModeActive" in self._options.features:
            return
        try:
            if arv("camera_are_chunks_available", camera):
                arv("camera_set_chunk_mode", camera, 1)
                self._parser = arv("camera_create_chunk_parser", camera)
        except GenicamError as error:
            log.info("%s: no settings with each frame: %s", self._name, error)
        if self._parser is None:
            return
        for one in MEANINGS:
            try:
                if one is EXPOSURE or arv("camera_is_feature_available", camera, one.feature):
                    arv("camera_set_chunk_state", camera, one.feature, 1)
                    self._chunks.append(one)
            except GenicamError as error:
                log.info("%s: no %s with each frame: %s", self._name, one.word, error)
        with suppress(GenicamError):
            self._longest_s = Control(arv, camera, EXPOSURE).bounds()[1] or math.inf

    def _find_latch(self) -> None:
        """See how the camera's clock is read, if it can be."""
        for command, value in _LATCHES:
            if all(self._arv("camera_is_feature_available", self._camera, one) for one in (command, value)):
                self._latch = command, value
                break
        self._ticks_hz = 1e9
        if self._latch == _LATCHES[1] and self._arv("camera_is_feature_available", self._camera, _TICKS):
            self._ticks_hz = float(self._arv("camera_get_integer", self._camera, _TICKS)) or 1e9

    def _begin(self) -> None:
        """Make the buffers and start."""
        arv, camera = self._arv, self._camera
        payload = arv("camera_get_payload", camera)
        self.format = PictureFormat(self._options.format, self._options.size_px, 0, payload)
        if self._is_gige:
            arv("camera_gv_set_stream_options", camera, PACKET_SOCKET_DISABLED)
        self._stream = arv("camera_create_stream", camera, None, None, None)
        if not self._stream:
            raise StreamFailed("Aravis made no stream", device=self._name)
        for _ in range(self._options.buffers):
            arv("stream_push_buffer", self._stream, arv("buffer_new_allocate", payload))
        arv("camera_start_acquisition", camera)

    @property
    def camera_name(self) -> str:
        """Maker, model and serial number."""
        names = ("vendor_name", "model_name", "device_serial_number")
        return " ".join(self._arv(f"camera_get_{name}", self._camera) or "?" for name in names)

    def read_clock(self) -> tuple[float, float, float] | None:
        """Return our time before, the camera's, ours after, seconds; None if its clock cannot be read.

        Raises StreamFailed if the camera does not answer.
        """
        if self._latch is None:
            return None
        command, value = self._latch
        try:
            with self._feature_lock:
                before_s = time.monotonic()
                self._arv("camera_execute_command", self._camera, command)
                after_s = time.monotonic()
                ticks = self._arv("camera_get_integer", self._camera, value)
        except GenicamError as error:
            raise StreamFailed(f"its clock cannot be read: {error}", device=self._name) from None
        return before_s, ticks / self._ticks_hz, after_s

    def settings(self) -> list[CameraSetting]:
        """Return what may be changed, as the camera has it now. Raises DriverError."""
        with self._feature_lock:
            self._check_open()
            try:
                return settings_of(self._arv, self._camera, self.period_s)
            except GenicamError as error:
                raise StreamFailed(f"its settings cannot be read: {error}", device=self._name) from None

    def change(
        self, wanted: Mapping[str, float], in_force: Mapping[str, ValuesSet]
    ) -> tuple[dict[str, float], list[str], DriverError | None]:
        """Change settings, as `drivers.aravis.settings.change`. Raises NoCamera if it was closed."""
        with self._feature_lock:
            self._check_open()
            return change(self._arv, self._camera, wanted, in_force, self._name)

    def _check_open(self) -> None:
        if not self._camera:
            raise NoCamera("it went away", device=self._name)

    def wait(self, timeout_s: float) -> Filled | None:
        """Wait for the next buffer; None if none came."""
        arv = self._arv
        handle = arv("stream_timeout_pop_buffer", self._stream, max(0, int(1e6 * timeout_s)))
        if not handle:
            return None
        now_s, wall_s = time.monotonic(), time.time()
        status = arv("buffer_get_status", handle)
        ago_s = self._wall.ago_s(1e-9 * arv("buffer_get_system_timestamp", handle), wall_s, now_s)
        wrong = "" if status == 0 else STATUS.get(status, f"Aravis says status {status}")
        return Filled(
            handle,
            wrong or self._wrong_picture(handle),
            arv("buffer_get_frame_id", handle),
            1e-9 * arv("buffer_get_timestamp", handle),
            now_s - ago_s,
            {} if wrong else self._sent_with(handle),
        )

    def _wrong_picture(self, handle: int) -> str:
        """What is wrong with a whole frame's size or format; empty if nothing."""
        width, height = self.format.size_px
        if self._arv("buffer_get_n_parts", handle) != 1:
            return "it comes in another form than one image"
        got = self._arv("buffer_get_image_width", handle), self._arv("buffer_get_image_height", handle)
        return (
            "" if got == (width, height) else f"it has {got[0]}x{got[1]} px where {width}x{height} were set"
        )

    def _sent_with(self, handle: int) -> dict[str, float]:
        """The settings that came with a buffer; those that cannot be true are left out."""
        values = {}
        for one in self._chunks:
            with suppress(GenicamError):  # not in this frame
                chunk = self._arv("chunk_parser_get_float_value", self._parser, handle, f"Chunk{one.feature}")
                value = one.unit * float(chunk)
                highest = self._longest_s * (1 + SAME)
                if math.isfinite(value) and (one is not EXPOSURE or 0.0 < value <= highest):
                    values[one.name] = value
                elif not self._chunk_warned:
                    self._chunk_warned = True
                    message = "%s: a frame came with %s %.6g, which cannot be; such values are left out"
                    log.warning(message, self._name, one.name, value)
        return values

    def bytes_of(self, handle: int) -> tuple[NDArray[np.uint8], PictureFormat]:
        """Return a buffer's picture, uint8 (n,), which is Aravis's memory, and how it is laid out.

        Chunk data, which a camera appends to the picture, may stand behind it.
        """
        size = ctypes.c_size_t()
        data = self._arv("buffer_get_image_data", handle, ctypes.byref(size))
        if not data or not size.value:
            return np.empty(0, np.uint8), self.format
        memory = memoryview((ctypes.c_uint8 * size.value).from_address(data))
        return np.frombuffer(memory, np.uint8), self.format

    def queue(self, handle: int) -> None:
        """Give a buffer back to be filled."""
        self._arv("stream_push_buffer", self._stream, handle)

    def close(self) -> None:
        """Stop and let go; never raises. It takes seconds for a camera that is gone: Aravis queries it
        again."""
        with self._feature_lock:
            if self._stream is not None:
                try:
                    self._arv("camera_stop_acquisition", self._camera)
                except GenicamError as error:
                    log.info("%s: stopping: %s", self._name, error)
            for handle in (self._parser, self._stream, self._camera):
                if handle:
                    self._arv.unref(handle)
            self._parser = self._stream = None
            self._camera = 0

    def _opening_error(self, error: GenicamError) -> DriverError:
        """A refusal of Aravis while opening, as one of ours."""
        reason = str(error)
        if ("ccess" in reason and "denied" in reason) or "controller" in reason.lower():
            return CameraBusy(f"another program has it ({reason})", device=self._name)
        return StreamFailed(f"it cannot be set up: {reason}", device=self._name)
