"""Pebbles painted over a picture of sand."""

from __future__ import annotations

import math

from drivers.sim.kernels.compiling import entry
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
