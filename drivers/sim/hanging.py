"""A camera whose calls can hang, each by itself: the fault word ``hang``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any

from drivers.clock import Clock
from drivers.faults import FaultPanel
from drivers.interfaces import Frame, FrameTime, HoldsExposure

ANY, NEXT_FRAME, CLOSE, RECENT_TIMES, SIZE_PX, EXPOSURE_HELD = range(6)
"""What the parameter ``call`` names."""

LOOKED_AGAIN_S = 0.5
"""For a clock that is turned by hand: it wakes nobody."""


class HangingCamera:
    """A simulated camera as the service has it: every call a camera can have, and each can hang.

    A call that hangs returns when the fault is over, also when the camera was closed meanwhile, as a driver
    that waits for its kernel does.

    Parameters
    ----------
    camera
        The camera behind it; its own calls do not hang.
    size_px
        (width, height) of its pictures.
    clock, faults
        The simulation's.
    """

    def __init__(self, camera: Any, size_px: tuple[int, int], clock: Clock, faults: FaultPanel) -> None:
        self._camera = camera
        self._size_px = size_px
        self._clock = clock
        self._faults = faults
        self._changed = clock.signal()
        faults.listen(self._wake)

    @property
    def name(self) -> str:
        """The camera's name, also the device name of its faults."""
        return str(self._camera.name)

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Frame:
        """Return the next frame, as the camera behind it."""
        self._hang(NEXT_FRAME)
        frame: Frame = self._camera.next_frame(exposed_after_s, timeout_s)
        return frame

    def close(self) -> None:
        """Let go."""
        self._hang(CLOSE)
        self._camera.close()

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) of its pictures."""
        self._hang(SIZE_PX)
        return self._size_px

    @property
    def period_s(self) -> float:
        """From frame to frame, seconds, at the rate of now."""
        return float(self._camera.period_s)

    @property
    def trigger(self) -> str:
        """What starts its exposures, as the camera behind it."""
        return str(self._camera.trigger)

    def recent_times(self) -> Sequence[FrameTime]:
        """Return the times of recent frames, as the camera behind it."""
        self._hang(RECENT_TIMES)
        times: Sequence[FrameTime] = self._camera.recent_times()
        return times

    def exposure_held(self) -> AbstractContextManager[None]:
        """Return a context in which the exposure does not change."""
        return self._held()

    @contextmanager
    def _held(self) -> Iterator[None]:
        self._hang(EXPOSURE_HELD)
        if not isinstance(self._camera, HoldsExposure):
            yield
            return
        with self._camera.exposure_held():
            yield

    def _hang(self, call: int) -> None:
        """Wait until no fault holds this call."""
        with self._changed:
            while True:
                now_s = self._clock.now_s()
                fault = self._faults.find(self.name, "hang", now_s)
                if fault is None or fault.number("call") not in (ANY, call):
                    return
                # Idle: that a call hangs makes no time pass where nobody else waits.
                self._changed.wait(min(LOOKED_AGAIN_S, fault.end_s - now_s), idle=True)

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()
