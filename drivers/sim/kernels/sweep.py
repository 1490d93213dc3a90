"""The rays of a block of pixels against the ground together, cell by cell: one triangle for all of them.

A walk (`drivers.sim.kernels.ground.walk`) takes each ray through the cells by itself. Neighbouring rays meet
the same few triangles, so here each triangle is looked up once and tried on all rays, by a loop that becomes
vector instructions. What is not met within a budget walks on from where the sweep ended.
"""

from __future__ import annotations

import math

from drivers.sim.kernels.compiling import inlined, part
from drivers.sim.kernels.world import FAR, Float64, Grid

BUDGET = 32  # cells, and one more a ray, that are tried before the rest walks on
LEVEL_PART = 0.1  # a bundle that goes less than this to the side for each metre is left to the walk
OVERLAP = 1e-9  # of a cell: triangles overlap rather than leave a gap


DX, DY, DE, MET_A, MET_B = 0, 1, 2, 3, 4
"""Rows of a bundle (5, n) of rays from one point. Directions are in metres, not-a-number where there is none.
What a ray met, it met at met_a / met_b metres; met_b is 0 as long as it met nothing."""


@inlined
def bounds(bundle: Float64, row: int, count: int) -> tuple[float, float]:
    """Least and largest of a row's first ``count`` numbers; (FAR, -FAR) if none is one."""
    low, high = FAR, -FAR
    for i in range(count):
        value = bundle[row, i]
        low = value if value < low else low
        high = value if value > high else high
    return low, high


@part
def try_triangle(
    bundle: Float64,
    count: int,
    major: int,
    minor: int,
    scale: float,
    above: float,
    rise_major: float,
    rise_minor: float,
    u: float,
    v: float,
) -> None:
    """Try the triangle (0, 0), (1, 0), (1, 1) of a cell, its ``major`` direction first, on all rays.

    The rays begin at (u, v) in cells, ``above`` metres over the triangle's plane with its rise a cell each
    way. A ray that comes down on the plane does so at s = above / b; everything is multiplied by b.
    """
    if above <= 0.0:  # then no ray comes down on it from above
        return
    along = above * scale
    for i in range(count):
        b = scale * (bundle[major, i] * rise_major + bundle[minor, i] * rise_minor) - bundle[DE, i]
        m, k = u * b + along * bundle[major, i], v * b + along * bundle[minor, i]
        gap = OVERLAP * b
        inside = (k >= -gap) & (m <= b + gap) & (m - k >= -gap)
        met = inside & (b > 0.0) & (above * bundle[MET_B, i] < bundle[MET_A, i] * b)
        bundle[MET_A, i] = above if met else bundle[MET_A, i]
        bundle[MET_B, i] = b if met else bundle[MET_B, i]


@part
def sweep(
    grid: Grid, bundle: Float64, count: int, ox: float, oy: float, oe: float, start: float, along_x: bool
) -> float:
    """Let the rays of a bundle meet the cells from ``start`` on; return how far all is known, metres.

    Goes column by column along x (or y), over the rows that any of the rays can be over there.
    """
    scale = 1.0 / grid.cell_m
    n = grid.cells
    major, minor = (DX, DY) if along_x else (DY, DX)
    pm, pk = (ox - grid.x0_m) * scale, (oy - grid.y0_m) * scale
    if not along_x:
        pm, pk = pk, pm
    m_low, m_high = bounds(bundle, major, count)
    k_low, k_high = bounds(bundle, minor, count)
    e_low, _ = bounds(bundle, DE, count)
    onward = 1 if m_low > 0.0 else -1
    slow, fast = (m_low, m_high) if onward > 0 else (m_high, m_low)  # of the least and the most speed
    if not abs(slow) > LEVEL_PART:
        return start
    column = math.floor(pm + start * slow * scale)
    tried = 0
    s_in = start
    while 0 <= column < n and tried < BUDGET + count:
        if e_low > 0.0 and oe + s_in * e_low > grid.highest_m:
            return FAR
        side = column + (onward + 1) // 2
        s_out = max((side - pm) / (slow * scale), s_in)
        low = math.floor(pk + min(s_in * k_low, s_out * k_low) * scale)
        high = math.floor(pk + max(s_in * k_high, s_out * k_high) * scale)
        lowest = oe + min(s_in * e_low, s_out * e_low)
        if low < 0 or high >= n:
            return s_in
        changed = False
        for row in range(low, high + 1):
            ix, iy = (column, row) if along_x else (row, column)
            h00, h11 = float(grid.elevation_m[iy, ix]), float(grid.elevation_m[iy + 1, ix + 1])
            hm, hk = float(grid.elevation_m[iy, ix + 1]), float(grid.elevation_m[iy + 1, ix])
            if not along_x:
                hm, hk = hk, hm
            if lowest > max(max(h00, h11), max(hm, hk)):
                continue
            u, v = pm - column, pk - row
            first = oe - h00 - u * (hm - h00) - v * (h11 - hm)
            try_triangle(bundle, count, major, minor, scale, first, hm - h00, h11 - hm, u, v)
            second = oe - h00 - v * (hk - h00) - u * (h11 - hk)
            try_triangle(bundle, count, minor, major, scale, second, hk - h00, h11 - hk, v, u)
            tried += 1
            changed = True
        s_in = max((side - pm) / (fast * scale), s_in)
        if changed:
            left = 0
            for i in range(count):
                left += 1 if bundle[MET_B, i] == 0.0 else 0
            if left == 0:
                return FAR
        column += onward
    return s_in
