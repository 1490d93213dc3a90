"""Noise of a picture: whole numbers make the chance, a table the bell, so that machines agree to the bit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.sim.kernels.compiling import entry, inlined
from drivers.sim.kernels.world import Float32


@inlined
def mixed(state: np.uint64) -> np.uint64:
    """64 bits that look like chance, of a counter: the finaliser of SplitMix64 (Steele, Lea, Flood 2014)."""
    z = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@entry
def noisy_levels(
    clean: Float32, sigma: Float32, bell: Float32, seed: np.uint64, levels: NDArray[np.uint8]
) -> None:
    """Fill levels (n,) with clean (n,) plus sigma (n,) times chance, rounded to 0..255.

    ``bell`` (65536,) holds the deviates of the standard normal distribution at (k + 0.5) / 65536.
    """
    gamma = np.uint64(0x9E3779B97F4A7C15)
    state = seed
    for start in range(0, clean.shape[0], 4):
        state += gamma
        bits = mixed(state)
        for k in range(start, min(start + 4, clean.shape[0])):
            value = clean[k] + sigma[k] * bell[bits & np.uint64(0xFFFF)]
            bits >>= np.uint64(16)
            value = min(max(value, np.float32(0)), np.float32(255))
            levels[k] = np.uint8(value + np.float32(0.5))
