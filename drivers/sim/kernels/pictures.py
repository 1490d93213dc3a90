"""What is done to whole pictures: pebbles painted over sand, and noise that machines agree on to the bit."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from drivers.sim.kernels.compiling import entry, inlined
from drivers.sim.kernels.world import Float32, Float64


@entry
def lay_pebbles(
    tones: Float32, rough: Float32, pebbles: Float64, sun_x: float, sun_y: float, sun_up: float
) -> None:
    """Paint pebbles (n, 6: x, y, half length, half width, turn, tone) over a repeating picture, in order.

    ``rough`` (same size) frays the outlines; each pebble is a lit dome with its shadow beside it.
    """
    size = tones.shape[0]
    mask = size - 1
    flat = math.sqrt(sun_x * sun_x + sun_y * sun_y)
    throw = 0.45 * flat / sun_up
    for k in range(pebbles.shape[0]):
        x, y, a, b, turn, tone = pebbles[k]
        c, sn = math.cos(turn), math.sin(turn)
        for part in range(2):
            reach = int(a * 1.3) + 2
            if part == 0:
                mx, my = x - sun_x / flat * throw * b, y - sun_y / flat * throw * b
            else:
                mx, my = x, y
            for j in range(int(my) - reach, int(my) + reach + 1):
                for i in range(int(mx) - reach, int(mx) + reach + 1):
                    px, py = i + 0.5 - mx, j + 0.5 - my
                    lu, lv = (c * px + sn * py) / a, (c * py - sn * px) / b
                    d2 = lu * lu + lv * lv
                    jj, ii = j & mask, i & mask
                    edge = d2 + 0.35 * rough[jj, ii]
                    if edge >= 1.0:
                        continue
                    if part == 0:
                        tones[jj, ii] *= 0.55 + 0.45 * max(edge, 0.0)
                        continue
                    # the normal of a flattish dome in picture axes
                    gu, gv = lu * 0.9, lv * 0.9
                    nx, ny = c * gu - sn * gv, sn * gu + c * gv
                    norm = 1.0 / math.sqrt(nx * nx + ny * ny + 1.0)
                    light = max((nx * sun_x + ny * sun_y + sun_up) * norm, 0.0)
                    tones[jj, ii] = tone * (0.3 + 0.7 * light / sun_up) * (1.0 + 0.12 * rough[jj, ii])


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
