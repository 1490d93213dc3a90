"""Brightness of a texture over the footprint of a ray."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from drivers.sim.kernels.compiling import inlined
from drivers.sim.kernels.world import ONE, PAD, Texture

MAX_TAPS = 12


@inlined
def texel_between(texels: NDArray[np.uint16], start: int, size: int, u: float, v: float) -> float:
    """Bilinear value at (u, v) texels in the level that begins at ``start`` and is ``size`` texels wide."""
    u -= 0.5
    v -= 0.5
    floor_u = math.floor(u)
    floor_v = math.floor(v)
    u -= floor_u
    v -= floor_v
    i, j = int(floor_u), int(floor_v)
    mask = size - 1
    first = start + (j & mask) * (size + PAD) + (i & mask)
    below = first + size + PAD
    a, b = float(texels[first]), float(texels[first + 1])
    c, d = float(texels[below]), float(texels[below + 1])
    top = a + u * (b - a)
    return top + v * (c + u * (d - c) - top)


@inlined
def halvings(width: float) -> float:
    """log2 of a width of one or more, but straight between whole numbers: continuous, which is enough."""
    bits = np.float32(width).view(np.int32)
    return float(bits - 1065353216) * (1.0 / 8388608.0)


@inlined
def brightness(
    texture: Texture, x: float, y: float, width_m: float, ax: float, ay: float, taps: int
) -> float:
    """Mean, 1 = the texture's own, over ``taps`` places spread along (ax, ay) about (x, y), metres.

    Each is bilinear in the level whose texels are as wide as ``width_m``, with a short blend between levels.
    """
    inv = 1.0 / texture.texel_m
    width = width_m * inv
    level, part = 0, 0.0
    if width > 1.0:
        lod = min(halvings(width), texture.levels - 1.001)
        level = int(lod)
        part = min(max(4.0 * (lod - level) - 1.5, 0.0), 1.0)
    start0, size0 = texture.start[level], texture.size >> level
    start1, size1 = texture.start[level + 1], texture.size >> (level + 1)
    scale = inv / (1 << level)
    x, y, ax, ay = x * scale, y * scale, ax * scale, ay * scale
    total = 0.0
    gap = 1.0 / taps
    for k in range(taps):
        f = (k + 0.5) * gap - 0.5
        u, v = x + f * ax, y + f * ay
        if part < 1.0:
            total += (1.0 - part) * texel_between(texture.texels, start0, size0, u, v)
        if part > 0.0:
            total += part * texel_between(texture.texels, start1, size1, 0.5 * u, 0.5 * v)
    return total * gap * (1.0 / ONE)


@inlined
def stretched_brightness(
    texture: Texture, x: float, y: float, short_m: float, long_m: float, ux: float, uy: float
) -> float:
    """Mean over a footprint ``short_m`` wide and ``long_m`` long in direction (ux, uy), by taps along it."""
    # a tap reaches 1.5 times as far as the footprint is wide, and never less than one texel
    taps = max(min(math.ceil(long_m / max(1.5 * short_m, texture.texel_m)), MAX_TAPS), 1)
    width_m = max(short_m, 0.7 * long_m / taps)
    if taps == 1:
        return brightness(texture, x, y, width_m, 0.0, 0.0, 1)
    return brightness(texture, x, y, width_m, long_m * ux, long_m * uy, taps)
