"""From light to a frame's bytes: exposure, gain, a filter over each pixel, noise, grey levels, JPEG.

A camera's own automatic exposure sees each frame, requested or not, and what it decides shows some frames
later. It is metered on a coarse picture without noise, so it is a function of where the camera was pointed.
"""

from __future__ import annotations

import functools
import math
import threading
import zlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from statistics import NormalDist

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import Image
from drivers.sim import kernels
from drivers.sim.settings import ExposureSettings

Float32 = NDArray[np.float32]

FRAMES_KEPT = 64
"""So many frames are metered at most to catch up with the present."""

CHANGES_S = 5.0
"""So old may a frame be that is requested after a change."""

MOST_STEP = 4.0
"""A loop changes by no more than this factor a frame."""

SEEN = np.array([0.55, 1.0, 0.6], dtype=np.float32)
"""What a pixel under a red, green, blue filter makes of the same white light; its balance is undone after."""

TINT = np.array([1.0, 0.86, 0.70], dtype=np.float32)
"""Red, green and blue of the scene's light over what it is drawn with: dry ground."""


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

    def fixed(self) -> AbstractContextManager[None]:
        """Return a context in which nothing changes: nothing does so by itself."""
        return nullcontext()

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
        self._fixed: list[list[float]] = []  # from when until when the exposure stays as it is
        self._lock = threading.Lock()

    @property
    def now(self) -> None:
        """No time and gain: they follow the pictures."""
        return None

    @contextmanager
    def fixed(self) -> Iterator[None]:
        """Keep the exposure of all frames that begin inside the block as it is."""
        span = [self._now_s(), math.inf]
        with self._lock:
            self._fixed = [*self._fixed[-50:], span]
        try:
            yield
        finally:
            span[1] = self._now_s()

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
        if seen < 0 or any(since_s <= begin_s < until_s for since_s, until_s in self._fixed):
            return before_s
        seen_s = begin_s - s.lag_frames * period_s
        seen_with_s = amounts_s.get(seen, before_s)
        brightness = seen_with_s / s.reference_s
        mean_dn = float(np.clip(self._metered(seen_s) * brightness, 0.5, 255.0).mean())
        step: float = min(max((s.target_dn / mean_dn) ** s.share, 1 / MOST_STEP), MOST_STEP)
        return min(max(seen_with_s * step, s.shortest_s), s.longest_s * s.most_gain)


@functools.cache
def bell() -> Float32:
    """Return (65536,) deviates of the normal distribution, each as likely as the others."""
    inverse = NormalDist().inv_cdf
    return np.array([inverse((number + 0.5) / 65536) for number in range(65536)], dtype=np.float32)


@dataclass(frozen=True)
class Readout:
    """How one camera reads its sensor; seed, camera and a frame's sequence number fix every pixel's noise.

    The noise's deviation in the dark and what mid grey (128) adds, grey levels, are those of gain 1. With
    ``colour`` the pixels lie under red, green and blue filters (RGGB), and pictures are (h, w, 3) BGR.
    """

    read_dn: float
    shot_dn: float
    seed: int
    camera: str
    colour: bool = False
    jpeg_quality: int = 0
    _kept: list[tuple[Float32, FrameExposure, Float32, Float32]] = field(default_factory=list, repr=False)

    def picture(self, light: Float32, sequence: int, shot: FrameExposure) -> Image:
        """Return frame ``sequence``, uint8 (h, w) or (h, w, 3) BGR, of the light (h, w) on the sensor."""
        levels, sigma_dn = self._levels(light, shot)
        state = np.random.SeedSequence([self.seed, zlib.crc32(self.camera.encode()), sequence])
        raw: Image = np.empty(levels.shape, dtype=np.uint8)
        kernels.noisy_levels(
            np.ascontiguousarray(levels).ravel(),
            np.ascontiguousarray(sigma_dn).ravel(),
            bell(),
            state.generate_state(1, np.uint64)[0],
            raw.reshape(-1),
        )
        image = _demosaiced(raw) if self.colour else raw
        if not self.jpeg_quality:
            return image
        _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality])
        how = cv2.IMREAD_COLOR if self.colour else cv2.IMREAD_GRAYSCALE
        return np.asarray(cv2.imdecode(data, how), dtype=np.uint8)

    def _levels(self, light: Float32, shot: FrameExposure) -> tuple[Float32, Float32]:
        """Grey levels without noise, and the noise's deviation; kept for light that comes again."""
        for one, with_shot, levels, sigma_dn in self._kept:
            if one is light and with_shot == shot:
                return levels, sigma_dn
        levels = light if shot.factor == 1.0 else light * np.float32(shot.factor)
        if self.colour:
            levels = levels * _filters(levels.shape[0], levels.shape[1])
        read_dn, shot_dn = self.read_dn * shot.gain, self.shot_dn * shot.gain**0.5
        variance = read_dn**2 + shot_dn**2 / 128 * np.maximum(levels, np.float32(0))
        sigma_dn = np.sqrt(variance, dtype=np.float32)
        self._kept.clear()
        if not light.flags.writeable:  # a head at rest gives the same array again and again
            self._kept.append((light, shot, levels, sigma_dn))
        return levels, sigma_dn


def _demosaiced(raw: Image) -> Image:
    """Colour of each pixel from the filters around it, with red and blue brought up to green."""
    blue_green_red = cv2.cvtColor(raw, cv2.COLOR_BayerRGGB2BGR).astype(np.float32)
    balanced: Image = np.rint(np.clip(blue_green_red / SEEN[::-1], 0, 255)).astype(np.uint8)
    return balanced


def _filters(height: int, width: int) -> Float32:
    """(h, w) what the filter over each pixel lets through of the scene's light."""
    red, green, blue = SEEN * TINT
    share = np.full((height, width), green, dtype=np.float32)
    share[0::2, 0::2] = red
    share[1::2, 1::2] = blue
    return share
