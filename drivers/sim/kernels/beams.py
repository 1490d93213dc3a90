"""Beams that hold the rays of squares of pixels: made once a camera."""

from __future__ import annotations

import math

from drivers.sim.kernels.compiling import entry, inlined
from drivers.sim.kernels.world import Float32, Float64

ROUNDING = 1e-6  # of float32 directions and metres


@inlined
def step_between(rays: Float32, y: int, x: int, down: int, right: int) -> float:
    """Angle from a pixel's first ray to the neighbour's, at the picture's end to the one before; nan."""
    y = min(y, rays.shape[0] - 1 - down)
    x = min(x, rays.shape[1] - 1 - right)
    if y < 0 or x < 0:
        return math.nan
    total = 0.0
    for k in range(3):
        apart = float(rays[y + down, x + right, 0, k]) - float(rays[y, x, 0, k])
        total += apart * apart
    return math.sqrt(total)


@inlined
def middle(rays: Float32, y0: int, y1: int, x0: int, x1: int) -> tuple[float, float, float, int]:
    """Mean direction, a unit vector, of the rays of the pixels [y0, y1) x [x0, x1), and their number."""
    ax, ay, az, count = 0.0, 0.0, 0.0, 0
    for y in range(y0, y1):
        for x in range(x0, x1):
            for i in range(rays.shape[2]):
                if rays[y, x, i, 0] == rays[y, x, i, 0]:
                    ax, ay, az = ax + rays[y, x, i, 0], ay + rays[y, x, i, 1], az + rays[y, x, i, 2]
                    count += 1
    length = math.sqrt(ax * ax + ay * ay + az * az)
    inv = 1.0 / length if length > 0.0 else 0.0
    return ax * inv, ay * inv, az * inv, count


@inlined
def mean_step(rays: Float32, y0: int, y1: int, x0: int, x1: int, down: int, right: int) -> float:
    """Mean angle from the pixels [y0, y1) x [x0, x1) to their neighbours, 0 where there is none."""
    total, known = 0.0, 0
    for y in range(y0, y1):
        for x in range(x0, x1):
            step = step_between(rays, y, x, down, right)
            if step == step:
                total, known = total + step, known + 1
    return total / max(known, 1)


@entry
def hold_rays(rays: Float32, starts: Float32, samples: int, size: int, beams: Float64) -> None:
    """Fill beams (rows, columns, 6), as ``render_tiles`` wants them, for squares of ``size`` pixels."""
    for row in range(beams.shape[0]):
        for column in range(beams.shape[1]):
            y0, x0 = row * size, column * size
            y1, x1 = min(y0 + size, rays.shape[0]), min(x0 + size, rays.shape[1])
            ax, ay, az, count = middle(rays, y0, y1, x0, x1)
            spread, radius = 0.0, 0.0
            for y in range(y0, y1):
                for x in range(x0, x1):
                    for i in range(rays.shape[2]):
                        dx, dy, dz = rays[y, x, i, 0] - ax, rays[y, x, i, 1] - ay, rays[y, x, i, 2] - az
                        apart = dx * dx + dy * dy + dz * dz
                        spread = apart if apart > spread else spread  # never not-a-number
                        if starts.shape[0] > 0:
                            dx, dy, dz = starts[y, x, i, 0], starts[y, x, i, 1], starts[y, x, i, 2]
                            radius = max(radius, dx * dx + dy * dy + dz * dz)
            beams[row, column, 0], beams[row, column, 1], beams[row, column, 2] = ax, ay, az
            beams[row, column, 3] = math.sqrt(spread) + ROUNDING if count > 0 else math.nan
            beams[row, column, 4] = math.sqrt(radius) + ROUNDING if starts.shape[0] > 0 else 0.0
            pitch = mean_step(rays, y0, y1, x0, x1, 1, 0) * mean_step(rays, y0, y1, x0, x1, 0, 1)
            beams[row, column, 5] = math.sqrt(pitch) / samples
