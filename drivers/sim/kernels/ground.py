"""Rays and beams of rays against a heightfield of triangles, one by one or a block of pixels together.

A `walk` takes each ray through the cells by itself. Neighbouring rays meet the same few triangles, so in a
`sweep` each triangle is looked up once and tried on all rays, by a loop that becomes vector instructions.
What is not met within a budget walks on from where the sweep ended.
"""

from __future__ import annotations

import math

from drivers.sim.kernels.compiling import entry, inlined, part
from drivers.sim.kernels.world import FAR, Float64, Grid

SIGHT_M = 2000.0  # beams are followed no farther

BUDGET = 32  # cells, and one more a ray, that are tried before the rest walks on
LEVEL_PART = 0.1  # a bundle that goes less than this to the side for each metre is left to the walk
OVERLAP = 1e-9  # of a cell: triangles overlap rather than leave a gap

DX, DY, DE, MET_A, MET_B = 0, 1, 2, 3, 4
"""Rows of a bundle (5, n) of rays from one point. Directions are in metres, not-a-number where there is none.
What a ray met, it met at met_a / met_b metres; met_b is 0 as long as it met nothing."""


@inlined
def cell_crossing(
    grid: Grid,
    ix: int,
    iy: int,
    s0: float,
    s1: float,
    px: float,
    py: float,
    e: float,
    dx: float,
    dy: float,
    de: float,
) -> float:
    """Where between s0 and s1 the ray enters cell (ix, iy), FAR if nowhere; px, py, dx, dy in cells."""
    h00 = float(grid.elevation_m[iy, ix])
    h10 = float(grid.elevation_m[iy, ix + 1])
    h01 = float(grid.elevation_m[iy + 1, ix])
    h11 = float(grid.elevation_m[iy + 1, ix + 1])
    u = px - ix
    v = py - iy
    # height above the two planes, as a + s b: first x >= y, then y >= x
    a_x = e - h00 - u * (h10 - h00) - v * (h11 - h10)
    b_x = de - dx * (h10 - h00) - dy * (h11 - h10)
    a_y = e - h00 - v * (h01 - h00) - u * (h11 - h01)
    b_y = de - dy * (h01 - h00) - dx * (h11 - h01)
    side0 = (u - v) + s0 * (dx - dy)
    side1 = (u - v) + s1 * (dx - dy)
    split = s1
    if (side0 > 0.0) != (side1 > 0.0) and dx != dy:
        split = min(max((v - u) / (dx - dy), s0), s1)
    first_is_x = side0 > 0.0 or (side0 == 0.0 and side1 > 0.0)
    a = a_x if first_is_x else a_y
    b = b_x if first_is_x else b_y
    if a + s0 * b <= 0.0:
        return s0
    if a + split * b <= 0.0:
        return min(max(-a / b, s0), split)
    a = a_y if first_is_x else a_x
    b = b_y if first_is_x else b_x
    if split < s1 and a + s1 * b <= 0.0:
        return min(max(-a / b, split), s1)
    return FAR


@inlined
def walk(
    grid: Grid,
    px: float,
    py: float,
    e: float,
    dx: float,
    dy: float,
    de: float,
    start: float,
    end: float,
) -> tuple[float, int, int]:
    """First crossing from above between ``start``, over the grid, and ``end``; px, py, dx, dy in cells.

    Goes from block to block of cells, skipping one when the ray stays above its highest corner.
    """
    n = grid.cells
    inv_dx = 1.0 / dx if dx != 0.0 else FAR
    inv_dy = 1.0 / dy if dy != 0.0 else FAR
    s = start
    ix = min(max(math.floor(px + s * dx), 0), n - 1)
    iy = min(max(math.floor(py + s * dy), 0), n - 1)
    ahead_x = 1 if dx > 0.0 else 0
    ahead_y = 1 if dy > 0.0 else 0
    level = 1
    while True:
        bx = ix >> level
        by = iy >> level
        sx = (((bx + ahead_x) << level) - px) * inv_dx if dx != 0.0 else FAR
        sy = (((by + ahead_y) << level) - py) * inv_dy if dy != 0.0 else FAR
        s_out = max(s, min(min(sx, sy), end))
        if level > 0:
            peak = grid.peaks_m[grid.peak_start[level] + by * (n >> level) + bx]
            if min(e + s * de, e + s_out * de) <= peak:
                level -= 1
                continue
        else:
            hit = cell_crossing(grid, ix, iy, s, s_out, px, py, e, dx, dy, de)
            if hit < FAR:
                return hit, ix, iy
        if s_out >= end:
            return FAR, 0, 0
        s = s_out
        # step over the nearer side by whole numbers: the walk cannot stand still
        if sx <= sy:
            ix = ((bx + 1) << level) if ahead_x else (bx << level) - 1
            low = by << level
            iy = min(max(math.floor(py + s * dy), low), low + (1 << level) - 1)
        else:
            iy = ((by + 1) << level) if ahead_y else (by << level) - 1
            low = bx << level
            ix = min(max(math.floor(px + s * dx), low), low + (1 << level) - 1)
        if ix < 0 or iy < 0 or ix >= n or iy >= n:
            return FAR, 0, 0
        if level < grid.levels and ((ix >> (level + 1)) != (bx >> 1) or (iy >> (level + 1)) != (by >> 1)):
            level += 1


@part
def cross_grid(
    grid: Grid, ox: float, oy: float, oe: float, dx: float, dy: float, de: float, start: float, end: float
) -> tuple[float, int, int]:
    """First crossing from above of a ray with the grid between ``start`` and ``end`` metres: (s, ix, iy).

    s is FAR for a miss. The ray may begin and end outside the grid.
    """
    if de >= 0.0 and oe > grid.highest_m:
        return FAR, 0, 0
    if de > 0.0:
        end = min(end, (grid.highest_m - oe) / de)
    elif de < 0.0:
        end = min(end, (grid.lowest_m - 1e-6 - oe) / de)
        start = max(start, (grid.highest_m + 1e-9 - oe) / de)
    n = grid.cells
    inv_cell = 1.0 / grid.cell_m
    px = (ox - grid.x0_m) * inv_cell
    py = (oy - grid.y0_m) * inv_cell
    dx *= inv_cell
    dy *= inv_cell
    for p, d in ((px, dx), (py, dy)):
        if d != 0.0:
            near, far = -p / d, (n - p) / d
            start, end = max(start, min(near, far)), min(end, max(near, far))
        elif p < 0.0 or p > n:
            return FAR, 0, 0
    if start >= end:
        return FAR, 0, 0
    return walk(grid, px, py, oe, dx, dy, de, start, end)


@inlined
def cross_from_inside(
    grid: Grid, ox: float, oy: float, oe: float, dx: float, dy: float, de: float, start: float
) -> tuple[float, int, int]:
    """As `cross_grid`, for a ray that is over the grid at ``start``: no look at the grid's sides."""
    end = FAR
    if de >= 0.0:
        if oe + start * de > grid.highest_m:
            return FAR, 0, 0
        if de > 0.0:
            end = (grid.highest_m - oe) / de
    inv_cell = 1.0 / grid.cell_m
    px = (ox - grid.x0_m) * inv_cell
    py = (oy - grid.y0_m) * inv_cell
    return walk(grid, px, py, oe, dx * inv_cell, dy * inv_cell, de, start, end)


@entry
def over_ground(grid: Grid, x: float, y: float, e: float) -> bool:
    """Whether a point is over the grid's square and above its triangles."""
    px, py = (x - grid.x0_m) / grid.cell_m, (y - grid.y0_m) / grid.cell_m
    if not (0.0 <= px < grid.cells and 0.0 <= py < grid.cells):
        return False
    ix, iy = int(px), int(py)
    return cell_crossing(grid, ix, iy, 0.0, 0.0, px, py, e, 0.0, 0.0, 0.0) == FAR


@part
def cross_outer(
    inner: Grid,
    outer: Grid,
    ox: float,
    oy: float,
    oe: float,
    dx: float,
    dy: float,
    de: float,
    start: float,
) -> tuple[float, int, int]:
    """First crossing with the outer grid, after ``start`` and after leaving the inner one's square."""
    half = inner.cells * inner.cell_m * 0.5
    leave = FAR
    if dx != 0.0:
        leave = min(leave, (inner.x0_m + half + math.copysign(half, dx) - ox) / dx)
    if dy != 0.0:
        leave = min(leave, (inner.y0_m + half + math.copysign(half, dy) - oy) / dy)
    return cross_grid(outer, ox, oy, oe, dx, dy, de, max(leave, start), FAR)


@part
def clear_distance(
    grid: Grid,
    ox: float,
    oy: float,
    oe: float,
    dx: float,
    dy: float,
    de: float,
    spread: float,
    rho: float,
    start: float,
    step: float,
) -> float:
    """How far a whole beam of rays is clear of the ground, from below rather than above.

    Every ray of the beam keeps within rho + s * spread of the central ray's point at s. Begins at ``start``,
    known to be clear, with steps of ``step`` metres; stops at the edge of the grid.
    """
    n = grid.cells
    inv_cell = 1.0 / grid.cell_m
    level_flat = math.sqrt(dx * dx + dy * dy)
    s = start
    step = max(step, grid.cell_m)
    while s < SIGHT_M:
        radius = rho + (s + step) * spread
        low = min(oe + s * de, oe + (s + step) * de) - radius
        clear = low > grid.highest_m
        if not clear:
            x_a, x_b = ox + s * dx, ox + (s + step) * dx
            y_a, y_b = oy + s * dy, oy + (s + step) * dy
            x_low = math.floor((min(x_a, x_b) - radius - grid.x0_m) * inv_cell)
            x_high = math.floor((max(x_a, x_b) + radius - grid.x0_m) * inv_cell)
            y_low = math.floor((min(y_a, y_b) - radius - grid.y0_m) * inv_cell)
            y_high = math.floor((max(y_a, y_b) + radius - grid.y0_m) * inv_cell)
            if x_low < 0 or y_low < 0 or x_high >= n or y_high >= n:
                return s
            width = (step * level_flat + 2.0 * radius) * inv_cell
            level = 1
            while (1 << level) < width and level < grid.levels:
                level += 1
            clear = True
            for by in range(y_low >> level, (y_high >> level) + 1):
                for bx in range(x_low >> level, (x_high >> level) + 1):
                    if low <= grid.peaks_m[grid.peak_start[level] + by * (n >> level) + bx]:
                        clear = False
        if clear:
            s += step
            step *= 1.5
        else:
            step *= 0.5
            if step < radius or step < 0.5 * grid.cell_m:
                return s
    return s


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
