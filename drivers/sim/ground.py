"""Pictures of gravel and stone made from a seed, halved again and again for distant views."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from drivers.sim.compiled import kernels

Float32 = NDArray[np.float32]

DETAIL_TEXELS = 4096
DETAIL_TEXEL_M = 0.001
STONE_TEXELS = 1024
STONE_TEXEL_M = 0.001
# half length of the pebbles in texels (millimetres), and the share of the ground that each class covers
PEBBLES = ((1.2, 2.5, 0.22), (2.5, 5.0, 0.16), (5.0, 11.0, 0.10), (11.0, 24.0, 0.05), (24.0, 40.0, 0.012))


def fractal(
    size: int, rng: np.random.Generator, falloff: float, shortest_px: float, longest_px: float
) -> Float32:
    """Return repeating noise (size, size) of mean 0 and variance 1.

    Amplitude falls as frequency ** -falloff between the two wavelengths and is nil outside them.
    """
    spectrum = fft.rfft2(rng.standard_normal((size, size), dtype=np.float32))
    fy = fft.fftfreq(size).astype(np.float32)[:, None]
    fx = fft.rfftfreq(size).astype(np.float32)[None, :]
    frequency = np.hypot(fx, fy)
    inside = (frequency >= 1.0 / longest_px) & (frequency <= 1.0 / shortest_px)
    frequency[~inside] = 1.0
    spectrum *= np.where(inside, frequency ** np.float32(-falloff), np.float32(0.0))
    noise = fft.irfft2(spectrum, s=(size, size))
    return np.asarray(noise / noise.std(), dtype=np.float32)


def gravel(rng: np.random.Generator, sun: NDArray[np.float64], size: int) -> Float32:
    """Return a repeating picture of sand with pebbles, mean 1, lit from ``sun`` (unit, site frame)."""
    tones = 1.0 + 0.11 * fractal(size, rng, 0.9, 2.5, 400.0)
    rough = np.clip(fractal(size, rng, 1.2, 3.0, 40.0), -2.0, 2.0)
    layers = []
    for low, high, share in PEBBLES:
        count = int(share * size * size / (np.pi * 0.75 * (0.5 * (low + high)) ** 2))
        half_length = low * (high / low) ** rng.random(count)
        pebble = np.empty((count, 6))
        pebble[:, 0:2] = rng.random((count, 2)) * size
        pebble[:, 2] = half_length
        pebble[:, 3] = half_length * rng.uniform(0.55, 0.95, count)
        pebble[:, 4] = rng.uniform(0.0, np.pi, count)
        pebble[:, 5] = np.exp(rng.normal(0.0, 0.19, count))
        layers.append(pebble)
    kernels().lay_pebbles(tones, rough, np.concatenate(layers), sun[0], sun[1], -sun[2])
    tones = np.minimum(tones, 1.9)
    return np.asarray(tones / tones.mean(), dtype=np.float32)


def stone(rng: np.random.Generator, size: int) -> Float32:
    """Return a repeating picture of a rock's surface, mean 1: blotches, grain and pits."""
    tones = 1.0 + 0.13 * fractal(size, rng, 1.2, 3.0, 500.0) + 0.09 * fractal(size, rng, 0.3, 2.5, 16.0)
    pits = fractal(size, rng, 0.8, 6.0, 60.0)
    tones *= 1.0 - 0.40 * np.clip(pits - 1.2, 0.0, 1.0)
    return np.asarray(tones / tones.mean(), dtype=np.float32)


def pyramid(tones: Float32, texel_m: float) -> Any:
    """Return the ``kernels.Texture`` of a square picture of relative brightness, side a power of two.

    Each level is the 2 x 2 means of the one before, down to 4 texels across, so that edges stay aligned.
    """
    module = kernels()
    levels = [np.asarray(tones, dtype=np.float32)]
    while levels[-1].shape[0] > 4:
        n = levels[-1].shape[0] // 2
        levels.append(levels[-1].reshape(n, 2, n, 2).mean(axis=(1, 3), dtype=np.float32))
    padded = [np.pad(level, [(0, 1), (0, module.PAD)], mode="wrap") for level in levels]
    texels = np.concatenate([level.ravel() for level in padded])
    start = np.cumsum([0, *(level.size for level in padded[:-1])]).astype(np.int64)
    stored = np.clip(np.rint(texels * module.ONE), 0, 65535).astype(np.uint16)
    return module.Texture(stored, start, tones.shape[0], len(levels), texel_m)
