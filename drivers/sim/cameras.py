"""Simulated cameras: frames at fixed instants, rendered only on request.

Frame n of a camera is exposed at a fixed instant whether or not it is requested, so its sequence number is a
function of time and a frame that was not fetched is a gap. All cameras of a rover share the instants, as with
a hardware trigger, unless a camera's clock says otherwise. A camera remembers as many finished frames as a
capture ring would.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.geometry.mode import SensorMode
from drivers.clock import Clock
from drivers.errors import BadSetting, NoFreshFrame, NoReply
from drivers.faults import Fault, FaultPanel
from drivers.interfaces import Camera, CameraInfo, CameraSetting, Frame, FrameTime, Image
from drivers.sim.sensor import AutoExposure, FixedExposure, FrameExposure, Readout
from drivers.sim.settings import CameraSettings, ClockSettings

RING_FRAMES = 4
"""Finished frames that can still be fetched, as in a capture ring of four buffers."""

ANY, NEXT_FRAME, CLOSE, RECENT_TIMES, INFO, EXPOSURE_HELD, SETTINGS = range(7)
"""What the parameter ``call`` of the fault ``hang`` names."""

SHORTEST_S, LONGEST_SHARE = 1e-5, 0.99
"""Bounds of an exposure set at run time: the longest is a share of what a frame has room for."""

GAINS = 1.0, 64.0

_ROUNDING_S = 1e-9
"""A frame stamped at the requested moment is not after it, whatever rounding does on the way."""

CHECKED_AGAIN_S = 0.5
"""For a clock that is turned by hand: it wakes no thread."""


class SimulatedCameraClock:
    """Turns true times into stamps and back; both agree at ``start_s`` but for ``stamped_late_s``."""

    def __init__(self, settings: ClockSettings, start_s: float) -> None:
        self._pace = 1 + 1e-6 * settings.drift_ppm
        self._drift = 1e-6 * settings.drift_ppm if settings.own_stamps else 0.0
        self._late_s = settings.stamped_late_s
        self._start_s = start_s
        self.first_s = start_s + settings.offset_s
        """When frame 0 is exposed."""

    def true_period_s(self, period_s: float) -> float:
        """Return how long a period by this clock truly is."""
        return period_s / self._pace

    def stamp_s(self, true_s: float) -> float:
        """Return what stands on a frame of a moment."""
        return true_s + ((true_s - self._start_s) * self._drift + self._late_s)

    def true_s(self, stamp_s: float) -> float:
        """Return the moment that a stamp means, and a nanosecond for rounding."""
        since_s = stamp_s - self._late_s - self._start_s
        return stamp_s - (since_s * self._drift / (1 + self._drift) + self._late_s) + _ROUNDING_S


@dataclass(frozen=True)
class _Epoch:
    """A stretch of time with one frame rate."""

    start_s: float
    first_sequence: int
    period_s: float

    def begin_s(self, sequence: int) -> float:
        """When the exposure of a frame begins."""
        return self.start_s + (sequence - self.first_sequence) * self.period_s

    def after(self, time_s: float) -> int:
        """The first frame whose exposure begins after a moment."""
        sequence = self.first_sequence + int(np.floor((time_s - self.start_s) / self.period_s)) + 1
        while self.begin_s(sequence - 1) > time_s:
            sequence -= 1
        while self.begin_s(sequence) <= time_s:
            sequence += 1
        return max(self.first_sequence, sequence)


class SimulatedCamera(Camera):
    """One camera of the simulated rover; safe from any thread.

    Each call may hang by a fault. It returns when that is over, also when the camera was closed meanwhile, as
    a driver that waits for its kernel does.

    ``expose(begin_s, exposure_s)`` gives the noise-free picture (h, w) of an exposure whose first row begins
    then; one that it keeps is read-only. ``taken(sequence, mid_exposure_s)`` is called with every frame
    before it is handed out. ``metered(time_s)`` gives a coarse noise-free picture for an automatic exposure.
    All cameras of a rover have one ``start_s``, when the exposure of frame 0 begins.
    """

    def __init__(
        self,
        name: str,
        settings: CameraSettings,
        size_px: tuple[int, int],
        expose: Callable[[float, float], NDArray[np.float32]],
        taken: Callable[[int, float], None],
        clock: Clock,
        faults: FaultPanel,
        start_s: float,
        own: ClockSettings = ClockSettings(),  # noqa: B008  frozen
        sensor_mode: SensorMode | None = None,
        metered: Callable[[float], NDArray[np.float32]] | None = None,
    ) -> None:
        self.name = name
        self._settings = settings
        self._size_px = size_px
        self._expose = expose
        self._taken = taken
        self._clock = clock
        self._faults = faults
        self._lock = threading.Lock()
        self._epoch_lock = threading.Lock()
        self._own = SimulatedCameraClock(own, start_s)
        self._epochs = [_Epoch(self._own.first_s, 0, self._own.true_period_s(1 / settings.rate_hz))]
        self._last: Frame | None = None
        self._frozen: tuple[Fault, Image] | None = None
        noise = settings.read_noise_dn, settings.shot_noise_dn, settings.seed
        self._readout = Readout(*noise, name, settings.colour, settings.jpeg_quality)
        self._rolling_s = (size_px[1] - 1) * settings.row_time_s
        # the begin of an exposure, stated by its middle and length, comes back with another last bit
        self._rounding_s = 1e-9 if settings.row_time_s or settings.exposure.auto else 0.0
        self._exposure: FixedExposure | AutoExposure
        if settings.exposure.auto and metered is not None:
            self._exposure = AutoExposure(settings.exposure, settings.exposure_s, metered, clock.now_s)
        else:
            self._exposure = FixedExposure(settings.exposure, settings.exposure_s)
        self._sensor_mode = sensor_mode
        self._closed = threading.Event()
        self._changed = clock.signal()
        faults.listen(self._wake)

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Frame:
        """Return the first frame stamped as exposed after ``exposed_after_s``, waiting for it if need be.

        When that frame has left the ring already, the newest finished one comes instead; it is fresh too.
        Rendering takes its own time on top of ``timeout_s``, which bounds the wait on the simulation's clock.
        Raises NoFreshFrame if none came in time; the message says what came instead; NoReply under the fault
        ``intermittent``.
        """
        self._hang(NEXT_FRAME)
        now_s = self._clock.now_s()
        deadline_s = now_s + max(0.0, timeout_s)
        if self._faults.strikes(self.name, now_s):
            raise NoReply("no answer", device=self.name)
        after_s = self._own.true_s(exposed_after_s) + self._rounding_s
        while not self._closed.is_set():
            now_s = self._clock.now_s()
            sequence, epoch = self._wanted(after_s, now_s)
            ready_s = epoch.begin_s(sequence) + self._latency_s(now_s)
            if self._is_missing(sequence, epoch):
                after_s = epoch.begin_s(sequence)
                if after_s < deadline_s:
                    continue
                ready_s = np.inf
            if ready_s <= now_s:
                return self._frame(sequence, epoch)
            if now_s >= deadline_s:
                break
            self._clock.sleep(min(min(ready_s, deadline_s) - now_s, 0.5))
        raise NoFreshFrame(self._instead(exposed_after_s, timeout_s), device=self.name)

    def settings(self) -> list[CameraSetting]:
        """Return exposure and gain; its focus stands fixed."""
        self._hang(SETTINGS)
        fixed = self._exposure.now is not None
        exposure_s, gain = self._exposure.now or (None, None)
        refusal = "" if fixed else "is set by simulation.cameras.exposure.auto"
        longest_s = LONGEST_SHARE * (1 / self._settings.rate_hz - self._rolling_s)
        return [
            CameraSetting("exposure_s", exposure_s, SHORTEST_S, longest_s, 0.0, not fixed, refusal),
            CameraSetting("gain", gain, *GAINS, 0.0, not fixed, refusal),
        ]

    def adjust(self, wanted: Mapping[str, float]) -> list[str]:
        """Expose frames that begin from now on otherwise; nothing becomes another than wanted.

        Raises BadSetting for a camera that sets its exposure itself, and for a setting that it lacks.
        """
        self._hang(SETTINGS)
        lacks = set(wanted) - {"exposure_s", "gain"}
        if lacks or not isinstance(self._exposure, FixedExposure):
            message = f"the simulated camera has no {min(lacks)}" if lacks else "it sets its exposure itself"
            raise BadSetting(message, device=self.name)
        exposure_s, gain = self._exposure.now
        self._exposure.change(
            wanted.get("exposure_s", exposure_s), wanted.get("gain", gain), self._clock.now_s()
        )
        return []

    @property
    def info(self) -> CameraInfo:
        """Its mode, and its period of now; no trigger, since a fault may slow one camera's count."""
        self._hang(INFO)
        mode = self._sensor_mode
        size_px = None if mode is None else mode.size_px
        return CameraInfo(True, size_px, mode, self._epoch(self._clock.now_s()).period_s)

    def recent_times(self) -> Sequence[FrameTime]:
        """Return no times: they are not kept."""
        self._hang(RECENT_TIMES)
        return ()

    @contextmanager
    def exposure_held(self) -> Iterator[None]:
        """Return a context in which the exposure does not change."""
        self._hang(EXPOSURE_HELD)
        with self._exposure.fixed():
            yield

    def close(self) -> None:
        """Let go, as `end`."""
        self._hang(CLOSE)
        self.end()

    def end(self) -> None:
        """End a waiting call with NoFreshFrame within half a second; no fault hangs this."""
        self._closed.set()

    def _hang(self, call: int) -> None:
        """Wait until no fault holds this call."""
        with self._changed:
            while True:
                now_s = self._clock.now_s()
                fault = self._faults.find(self.name, "hang", now_s)
                if fault is None or fault.number("call") not in (ANY, call):
                    return
                # Idle: that a call hangs makes no time pass where no other thread waits.
                self._changed.wait(min(CHECKED_AGAIN_S, fault.end_s - now_s), idle=True)

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _wanted(self, after_s: float, now_s: float) -> tuple[int, _Epoch]:
        """The frame that the call is about, with its epoch."""
        epoch = self._epoch(now_s)
        sequence = epoch.after(after_s)
        newest = epoch.after(now_s - self._latency_s(now_s)) - 1
        if sequence <= newest - RING_FRAMES:
            sequence = newest
        return sequence, epoch

    def _epoch(self, now_s: float) -> _Epoch:
        """The frame rate of the moment; a ``slow`` fault that comes or goes begins a new epoch."""
        slow = self._faults.find(self.name, "slow", now_s)
        period_s = self._own.true_period_s(1 / self._settings.rate_hz) / (
            slow.number("factor") if slow else 1.0
        )
        with self._epoch_lock:
            epoch = self._epochs[-1]
            if period_s != epoch.period_s:
                sequence = epoch.after(now_s)
                first = self._epochs[0]
                periods = np.ceil((epoch.begin_s(sequence) - first.start_s) / period_s)
                epoch = _Epoch(first.start_s + float(periods) * period_s, sequence, period_s)
                self._epochs = [first, epoch]
            return epoch

    def _latency_s(self, now_s: float) -> float:
        """How long after its exposure begins a frame can be had."""
        delayed = self._faults.find(self.name, "delayed", now_s)
        late_s = delayed.number("delay_s") if delayed else 0.0
        return self._rolling_s + self._exposure.longest_s(now_s) + self._settings.readout_s + late_s

    def _is_missing(self, sequence: int, epoch: _Epoch) -> bool:
        """Whether a fault keeps this frame from coming at all."""
        begin_s = epoch.begin_s(sequence)
        if self._faults.find(self.name, "off", begin_s) or self._faults.find(self.name, "stuck", begin_s):
            return True
        dropped = self._faults.find(self.name, "dropped", begin_s)
        if dropped is None:
            return False
        chance = np.random.default_rng([int(dropped.number("seed")), sequence]).random()
        return bool(chance < dropped.number("probability"))

    def _frame(self, sequence: int, epoch: _Epoch) -> Frame:
        """Take the picture, once."""
        with self._lock:
            if self._last is None or self._last.sequence != sequence:
                shot = self._shot(sequence, epoch)
                image = self._picture(sequence, epoch, shot)
                image.setflags(write=False)
                begin_s, all_rows_s = epoch.begin_s(sequence), shot.exposure_s + self._rolling_s
                stamp_s = self._own.stamp_s(begin_s) + all_rows_s / 2
                settings = {"exposure_s": shot.exposure_s, "gain": shot.gain}
                self._last = Frame(image, sequence, stamp_s, all_rows_s, settings=settings)
                self._taken(sequence, begin_s + all_rows_s / 2)
            return self._last

    def _shot(self, sequence: int, epoch: _Epoch) -> FrameExposure:
        """Exposure time and gain of a frame."""
        return self._exposure.shot(sequence, epoch.begin_s(sequence), epoch.period_s)

    def _picture(self, sequence: int, epoch: _Epoch, shot: FrameExposure) -> Image:
        """The picture of an exposure, as a fault leaves it."""
        begin_s = epoch.begin_s(sequence)
        if fault := self._faults.find(self.name, "frozen", begin_s):
            if self._frozen is None or self._frozen[0] is not fault:
                before = epoch.after(fault.begin_s) - 1
                shot = self._shot(before, epoch)
                light = self._expose(epoch.begin_s(before), shot.exposure_s)
                self._frozen = (fault, self._readout.picture(light, before, shot))
            return self._frozen[1].copy()
        if fault := self._faults.find(self.name, "garbage", begin_s):
            generator = np.random.default_rng([int(fault.number("seed")), sequence])
            shape = (*self._size_px[::-1], 3) if self._settings.colour else self._size_px[::-1]
            return generator.integers(0, 256, shape, dtype=np.uint8)
        if self._faults.find(self.name, "dark", begin_s):
            return self._readout.picture(np.zeros(self._size_px[::-1], np.float32), sequence, shot)
        image = self._readout.picture(self._expose(begin_s, shot.exposure_s), sequence, shot)
        if fault := self._faults.find(self.name, "wrong", begin_s):
            shift = np.array([[1, 0, fault.number("dx_px")], [0, 1, fault.number("dy_px")]])
            shifted = cv2.warpAffine(image, shift, self._size_px, borderMode=cv2.BORDER_REPLICATE)
            return np.asarray(shifted, dtype=np.uint8)
        return image

    def _instead(self, exposed_after_s: float, timeout_s: float) -> str:
        """What to say when no fresh frame came."""
        if self._closed.is_set():
            return "it is closed"
        message = f"no frame exposed after the requested moment came within {timeout_s:.3g} s"
        now_s = self._clock.now_s()
        if stuck := self._faults.find(self.name, "stuck", now_s):
            epoch = self._epoch(now_s)
            sequence = epoch.after(stuck.begin_s) - 1
            age_s = exposed_after_s - epoch.begin_s(sequence)
            return f"{message}; only frame {sequence} came again and again, exposed {age_s:.3f} s before"
        if self._faults.find(self.name, "off", now_s) or self._last is None:
            return f"{message}; none came at all"
        age_s = exposed_after_s - (self._last.mid_exposure_s - self._last.exposure_s / 2)
        return f"{message}; the last one is frame {self._last.sequence}, exposed {age_s:.3f} s before"
