"""How long a simulated camera exposes, with what gain, and the loop that sets both from the pictures.

A camera's own automatic exposure sees each frame, requested or not, and what it decides shows some frames
later. It is metered here on a coarse picture without noise, so it is a function of where the camera looked.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from drivers.options import DriverOptions
from drivers.sim.optics.lens import Float32

FRAMES_KEPT = 64
"""So many frames are metered at most to catch up with the present."""

CHANGES_S = 5.0
"""So old may a frame be that is requested after a change."""

MOST_STEP = 4.0
"""A loop changes by no more than this factor a frame."""


class ExposureSettings(DriverOptions):
    """The ``exposure`` of every camera of a simulation."""

    reference_s: Annotated[float, Field(ge=0.0, le=1e3)] = 0.0
    """The exposure time that gives the scene its own brightness, at gain 1; grey levels grow with time and
    gain. 0: they do not."""
    gain: Annotated[float, Field(ge=1.0, le=64.0)] = 1.0
    """At the start."""
    auto: bool = False
    """Whether the camera sets time and gain itself, from ``exposure_s`` on."""
    target_dn: Annotated[float, Field(ge=10.0, le=245.0)] = 110.0
    """The grey level that it aims at."""
    share: Annotated[float, Field(ge=0.01, le=1.0)] = 0.5
    """Of the way there, in its logarithm, that a frame's decision goes."""
    lag_frames: Annotated[int, Field(ge=1, le=8)] = 2
    """From the frame that is metered to the first one with what was decided."""
    shortest_s: Annotated[float, Field(ge=1e-6, le=10.0)] = 0.0001
    """The shortest time."""
    longest_s: Annotated[float, Field(ge=0.0, le=1e3)] = 0.03
    """The longest time; gain rises where it is too short."""
    most_gain: Annotated[float, Field(ge=1.0, le=64.0)] = 8.0
    """The highest gain."""


@dataclass(frozen=True)
class FrameExposure:
    """Exposure time and gain of a frame; ``factor``: grey levels over the scene's own brightness."""

    exposure_s: float
    gain: float = 1.0
    factor: float = 1.0


class FixedExposure:
    """The same for every frame, until it is changed; safe from any thread.

    Without a ``reference_s`` the scene has its own brightness at what it begins with.
    """

    def __init__(self, settings: ExposureSettings, exposure_s: float) -> None:
        self._amount_s = settings.reference_s or exposure_s
        gain = settings.gain if settings.reference_s > 0 else 1.0
        # (since_s, exposure_s, gain), replaced as a whole
        self._set: tuple[tuple[float, float, float], ...] = ((-math.inf, exposure_s, gain),)

    @property
    def now(self) -> tuple[float, float]:
        """The newest exposure time and gain."""
        return self._set[-1][1:]

    def longest_s(self, now_s: float) -> float:
        """Return the longest exposure time of frames that are requested at a moment."""
        return max(exposure_s for _, exposure_s, _ in self._recent(now_s))

    def change(self, exposure_s: float, gain: float, now_s: float) -> None:
        """Expose frames that begin after a moment otherwise."""
        self._set = (*self._recent(now_s), (now_s, exposure_s, gain))

    def shot(self, _sequence: int, begin_s: float, _period_s: float) -> FrameExposure:
        """Return time and gain of the frame whose exposure begins at a moment."""
        changes = self._set
        _, exposure_s, gain = next((one for one in reversed(changes) if one[0] < begin_s), changes[0])
        return FrameExposure(exposure_s, gain, exposure_s * gain / self._amount_s)

    def _recent(self, now_s: float) -> tuple[tuple[float, float, float], ...]:
        """What a frame may have been taken with that is requested at a moment."""
        changes = self._set
        first = max(i for i, one in enumerate(changes) if i == 0 or one[0] < now_s - CHANGES_S)
        return changes[first:]


class AutoExposure:
    """A loop over a camera's frames; safe from any thread.

    ``metered(time_s)`` is a coarse picture of the moment at the scene's own brightness.
    """

    def __init__(
        self,
        settings: ExposureSettings,
        exposure_s: float,
        metered: Callable[[float], Float32],
        now_s: Callable[[], float],
    ) -> None:
        self._settings = settings
        self._exposure_s = exposure_s
        self._metered = metered
        self._now_s = now_s
        self._amounts_s: dict[int, float] = {}  # time times gain, by frame
        self._next_frame = 0
        self._holds: list[tuple[float, float]] = []
        self._held = 0
        self._held_since_s = 0.0
        self._lock = threading.Lock()

    @contextmanager
    def held(self) -> Iterator[None]:
        """Keep the exposure of all frames that begin inside the block as it is."""
        with self._lock:
            self._held += 1
            if self._held == 1:
                self._held_since_s = self._now_s()
        try:
            yield
        finally:
            with self._lock:
                self._held -= 1
                if self._held == 0:
                    self._holds = [*self._holds[-50:], (self._held_since_s, self._now_s())]

    def longest_s(self, _now_s: float) -> float:
        """Return the longest exposure time that a frame may have."""
        return self._settings.longest_s

    def shot(self, sequence: int, begin_s: float, period_s: float) -> FrameExposure:
        """Return time and gain of a frame; those before it are metered first, where they were not yet."""
        with self._lock:
            if sequence - self._next_frame > FRAMES_KEPT:
                last_s = self._amounts_s.get(self._next_frame - 1, self._exposure_s)
                self._next_frame = sequence - FRAMES_KEPT
                first = self._next_frame - self._settings.lag_frames
                self._amounts_s = dict.fromkeys(range(first, self._next_frame), last_s)
            while self._next_frame <= sequence:
                frame = self._next_frame
                frame_begin_s = begin_s - (sequence - frame) * period_s
                self._amounts_s[frame] = self._amount_s(frame, frame_begin_s, period_s)
                self._amounts_s.pop(frame - 2 * FRAMES_KEPT, None)
                self._next_frame += 1
            amount_s = self._amounts_s.get(sequence, self._exposure_s)
        s = self._settings
        exposure_s = min(max(amount_s, s.shortest_s), s.longest_s)
        gain = min(max(1.0, amount_s / exposure_s), s.most_gain)
        return FrameExposure(exposure_s, gain, exposure_s * gain / s.reference_s)

    def _amount_s(self, frame: int, begin_s: float, period_s: float) -> float:
        """Time times gain of a frame."""
        amounts_s, s = self._amounts_s, self._settings
        before_s = amounts_s.get(frame - 1, self._exposure_s)
        seen = frame - s.lag_frames
        if seen < 0 or self._is_held(begin_s):
            return before_s
        seen_s = begin_s - s.lag_frames * period_s
        seen_with_s = amounts_s.get(seen, before_s)
        brightness = seen_with_s / s.reference_s
        mean_dn = float(np.clip(self._metered(seen_s) * brightness, 0.5, 255.0).mean())
        step: float = min(max((s.target_dn / mean_dn) ** s.share, 1 / MOST_STEP), MOST_STEP)
        return min(max(seen_with_s * step, s.shortest_s), s.longest_s * s.most_gain)

    def _is_held(self, begin_s: float) -> bool:
        if self._held and begin_s >= self._held_since_s:
            return True
        return any(since_s <= begin_s < until_s for since_s, until_s in self._holds)
