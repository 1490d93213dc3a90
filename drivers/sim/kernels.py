"""The compiled heart of the renderer: rays against ground and rocks, and the light that comes back.

Everything here is numba; nobody imports this module but ``drivers.sim.compiled``. It is one module on
purpose: numba's disk cache looks at the file of the function called, not at the files of what that calls.

Geometry is float64. Inside, heights are *elevations*, up positive (site z is down): e = -z. Lengths along a
ray are metres because directions are unit vectors.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import numba
import numpy as np
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

Function = TypeVar("Function", bound=Callable[..., Any])
Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]

FAR = 1e30
NOTHING = -1


def compiled(function: Function) -> Function:
    """Compile with numba, without the interpreter lock, cached on disk where a folder can be written."""
    try:
        return cast(Function, numba.njit(cache=True, nogil=True, error_model="numpy")(function))
    except RuntimeError:  # neither __pycache__ nor the user's cache folder can be written
        return cast(Function, numba.njit(nogil=True, error_model="numpy")(function))


def inlined(function: Function) -> Function:
    """Compile into the callers."""
    return cast(Function, numba.njit(nogil=True, error_model="numpy", forceinline=True)(function))


class Grid(NamedTuple):
    """A square heightfield of triangles: each cell is cut from its (0, 0) to its (1, 1) corner.

    elevation_m (n + 1, n + 1) indexed [y, x]; peaks_m holds the highest corner of every block of 2**level
    cells, level 1 first, each level starting at peak_start[level]; the corner of cell (0, 0) is (x0_m, y0_m).
    """

    elevation_m: Float32
    peaks_m: Float32
    peak_start: Int64
    cells: int
    levels: int
    cell_m: float
    x0_m: float
    y0_m: float
    lowest_m: float
    highest_m: float


class Rocks(NamedTuple):
    """Closed meshes of 1280 triangles each, in the order of a subdivided icosahedron.

    Four triangles in a row have one parent, sixteen one grandparent, sixty-four one of the 20 first faces;
    boxes_a (k, 20, 6), boxes_b (k, 80, 6), boxes_c (k, 320, 6) bound those, as (low xyz, high xyz).
    spheres (k, 4) is (centre, radius); corners_m (k, 1280, 3, 3); normals (k, 1280, 3, 3), at the corners.
    """

    spheres_m: Float64
    boxes_a: Float64
    boxes_b: Float64
    boxes_c: Float64
    corners_m: Float64
    normals: Float32
    tones: Float32


class Texture(NamedTuple):
    """A square, repeating picture with its halved versions behind one another, level 0 first.

    Texel (i, j) of level k covers [i, i + 1) x [j, j + 1) times 2**k texels of level 0, so its centre is at
    (i + 0.5) 2**k: levels lie exactly on each other. Values are relative brightness times ``ONE``.
    """

    texels: NDArray[np.uint16]
    start: Int64
    size: int
    levels: int
    texel_m: float


class World(NamedTuple):
    """All that a ray can meet, and the light on it."""

    inner: Grid
    outer: Grid
    rocks: Rocks
    detail: Texture
    broad: Texture
    stone: Texture
    sun: Float64


def _borrowed(_context: Any, array: Any) -> Any:
    """Return the array without its owner, so that passing it on counts no references.

    The counts are atomic: with them a picture takes two to three times as long. The caller keeps the owner.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        proxy = numba_structs.create_struct_proxy(signature.return_type)(context, builder, value=arguments[0])
        proxy.meminfo = numba_structs.get_null_value(proxy.meminfo.type)
        return proxy._getvalue()

    return array(array), generate


numba_structs: Any = cgutils
borrowed = cast(Callable[[Any], Any], intrinsic(_borrowed))


@compiled
def borrowed_grid(grid: Grid) -> Grid:
    """The grid without owners."""
    return Grid(
        borrowed(grid.elevation_m),
        borrowed(grid.peaks_m),
        borrowed(grid.peak_start),
        grid.cells,
        grid.levels,
        grid.cell_m,
        grid.x0_m,
        grid.y0_m,
        grid.lowest_m,
        grid.highest_m,
    )


@compiled
def borrowed_rocks(rocks: Rocks) -> Rocks:
    """The rocks without owners."""
    return Rocks(
        borrowed(rocks.spheres_m),
        borrowed(rocks.boxes_a),
        borrowed(rocks.boxes_b),
        borrowed(rocks.boxes_c),
        borrowed(rocks.corners_m),
        borrowed(rocks.normals),
        borrowed(rocks.tones),
    )


@compiled
def borrowed_texture(texture: Texture) -> Texture:
    """The texture without owners."""
    return Texture(
        borrowed(texture.texels), borrowed(texture.start), texture.size, texture.levels, texture.texel_m
    )


ONE = 16384.0  # the texel value that means brightness 1
GROUND_TONE = 118.0
ROCK_TONE = 104.0
SKY_HORIZON = 196.0
SKY_ZENITH = 128.0
HAZE_M = 900.0
AMBIENT = 0.30
MAX_TAPS = 10


# ---------------------------------------------------------------- ground


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


@compiled
def cross_grid(
    grid: Grid, ox: float, oy: float, oe: float, dx: float, dy: float, de: float, start: float, end: float
) -> tuple[float, int, int]:
    """First crossing from above of a ray with the grid between ``start`` and ``end`` metres: (s, ix, iy).

    Walks blocks of cells, skipping a block when the ray stays above its highest corner. s is FAR for a miss.
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
    inv_dx = 1.0 / dx if dx != 0.0 else FAR
    inv_dy = 1.0 / dy if dy != 0.0 else FAR
    if dx != 0.0:
        near, far = -px * inv_dx, (n - px) * inv_dx
        start, end = max(start, min(near, far)), min(end, max(near, far))
    elif px < 0.0 or px > n:
        return FAR, 0, 0
    if dy != 0.0:
        near, far = -py * inv_dy, (n - py) * inv_dy
        start, end = max(start, min(near, far)), min(end, max(near, far))
    elif py < 0.0 or py > n:
        return FAR, 0, 0
    if start >= end:
        return FAR, 0, 0
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
            if min(oe + s * de, oe + s_out * de) <= peak:
                level -= 1
                continue
        else:
            hit = cell_crossing(grid, ix, iy, s, s_out, px, py, oe, dx, dy, de)
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


@compiled
def cross_outer(
    inner: Grid, outer: Grid, ox: float, oy: float, oe: float, dx: float, dy: float, de: float
) -> tuple[float, int, int]:
    """First crossing of a ray with the outer grid once it has left the square of the inner one."""
    half = inner.cells * inner.cell_m * 0.5
    leave = FAR
    if dx != 0.0:
        leave = min(leave, (inner.x0_m + half + math.copysign(half, dx) - ox) / dx)
    if dy != 0.0:
        leave = min(leave, (inner.y0_m + half + math.copysign(half, dy) - oy) / dy)
    return cross_grid(outer, ox, oy, oe, dx, dy, de, leave, FAR)


@compiled
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
    while s < 200.0:
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


# ---------------------------------------------------------------- rocks


@inlined
def meets_box(
    boxes: Float64,
    k: int,
    i: int,
    ox: float,
    oy: float,
    oz: float,
    ix: float,
    iy: float,
    iz: float,
    limit: float,
) -> bool:
    """Whether a ray (origin, 1 / direction) meets box i of rock k before ``limit``."""
    a, b = (boxes[k, i, 0] - ox) * ix, (boxes[k, i, 3] - ox) * ix
    near, far = min(a, b), max(a, b)
    a, b = (boxes[k, i, 1] - oy) * iy, (boxes[k, i, 4] - oy) * iy
    near, far = max(near, min(a, b)), min(far, max(a, b))
    a, b = (boxes[k, i, 2] - oz) * iz, (boxes[k, i, 5] - oz) * iz
    near, far = max(near, min(a, b)), min(far, max(a, b))
    return bool(far >= max(near, 0.0) and near < limit)


@inlined
def meets_triangle(
    corners: Float64, k: int, t: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> tuple[float, float, float]:
    """Möller and Trumbore's test: (s, weight of corner 1, weight of corner 2); s is FAR for a miss."""
    e1x, e1y, e1z = (
        corners[k, t, 1, 0] - corners[k, t, 0, 0],
        corners[k, t, 1, 1] - corners[k, t, 0, 1],
        corners[k, t, 1, 2] - corners[k, t, 0, 2],
    )
    e2x, e2y, e2z = (
        corners[k, t, 2, 0] - corners[k, t, 0, 0],
        corners[k, t, 2, 1] - corners[k, t, 0, 1],
        corners[k, t, 2, 2] - corners[k, t, 0, 2],
    )
    px, py, pz = dy * e2z - dz * e2y, dz * e2x - dx * e2z, dx * e2y - dy * e2x
    det = e1x * px + e1y * py + e1z * pz
    if det == 0.0:
        return FAR, 0.0, 0.0
    inv = 1.0 / det
    tx, ty, tz = ox - corners[k, t, 0, 0], oy - corners[k, t, 0, 1], oz - corners[k, t, 0, 2]
    u = (tx * px + ty * py + tz * pz) * inv
    if u < -1e-12 or u > 1.0 + 1e-12:
        return FAR, 0.0, 0.0
    qx, qy, qz = ty * e1z - tz * e1y, tz * e1x - tx * e1z, tx * e1y - ty * e1x
    v = (dx * qx + dy * qy + dz * qz) * inv
    if v < -1e-12 or u + v > 1.0 + 1e-12:
        return FAR, 0.0, 0.0
    s = (e2x * qx + e2y * qy + e2z * qz) * inv
    return (s, u, v) if s > 0.0 else (FAR, 0.0, 0.0)


@compiled
def meets_ball(
    balls: Float64, k: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, limit: float
) -> bool:
    """Whether a ray meets ball k of (centre, radius) before ``limit``."""
    cx, cy, cz, radius = balls[k, 0] - ox, balls[k, 1] - oy, balls[k, 2] - oz, balls[k, 3]
    along = cx * dx + cy * dy + cz * dz
    room = radius * radius - (cx * cx + cy * cy + cz * cz - along * along)
    if room < 0.0:
        return False
    reach = math.sqrt(room)
    return bool(along + reach > 0.0 and along - reach < limit)


@compiled
def cross_rock(
    rocks: Rocks, k: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, limit: float
) -> tuple[float, int, float, float]:
    """First meeting with rock k before ``limit``: (s, triangle, weights); s is FAR for a miss."""
    best, triangle, best_u, best_v = limit, NOTHING, 0.0, 0.0
    ix = 1.0 / dx if dx != 0.0 else FAR
    iy = 1.0 / dy if dy != 0.0 else FAR
    iz = 1.0 / dz if dz != 0.0 else FAR
    for a in range(20):
        if not meets_box(rocks.boxes_a, k, a, ox, oy, oz, ix, iy, iz, best):
            continue
        for b in range(4 * a, 4 * a + 4):
            if not meets_box(rocks.boxes_b, k, b, ox, oy, oz, ix, iy, iz, best):
                continue
            for c in range(4 * b, 4 * b + 4):
                if not meets_box(rocks.boxes_c, k, c, ox, oy, oz, ix, iy, iz, best):
                    continue
                for t in range(4 * c, 4 * c + 4):
                    s, u, v = meets_triangle(rocks.corners_m, k, t, ox, oy, oz, dx, dy, dz)
                    if s < best:
                        best, triangle, best_u, best_v = s, t, u, v
    if triangle == NOTHING:
        return FAR, NOTHING, 0.0, 0.0
    return best, triangle, best_u, best_v


# ---------------------------------------------------------------- light


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
    i0, i1 = i & mask, (i + 1) & mask
    row0, row1 = start + (j & mask) * size, start + ((j + 1) & mask) * size
    a, b = float(texels[row0 + i0]), float(texels[row0 + i1])
    c, d = float(texels[row1 + i0]), float(texels[row1 + i1])
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

    Each is trilinear for a footprint ``width_m`` wide.
    """
    inv = 1.0 / texture.texel_m
    width = width_m * inv
    level, part = 0, 0.0
    if width > 1.0:
        lod = min(halvings(width), texture.levels - 1.001)
        level = int(lod)
        part = lod - level
    start0, size0 = texture.start[level], texture.size >> level
    start1, size1 = texture.start[level + 1], texture.size >> (level + 1)
    scale = inv / (1 << level)
    x, y, ax, ay = x * scale, y * scale, ax * scale, ay * scale
    total = 0.0
    gap = 1.0 / taps
    for k in range(taps):
        f = (k + 0.5) * gap - 0.5
        u, v = x + f * ax, y + f * ay
        fine = texel_between(texture.texels, start0, size0, u, v)
        if part > 0.0:
            fine += part * (texel_between(texture.texels, start1, size1, 0.5 * u, 0.5 * v) - fine)
        total += fine
    return total / (taps * ONE)


@inlined
def stretched_brightness(texture: Texture, x: float, y: float, short_m: float, ax: float, ay: float) -> float:
    """Mean over a footprint ``short_m`` wide and (ax, ay) metres long, by evenly spaced taps along it."""
    long_m = math.sqrt(ax * ax + ay * ay)
    # a tap reaches twice as far as the footprint is wide, and never less than one texel
    taps = min(math.ceil(long_m / max(2.0 * short_m, texture.texel_m)), MAX_TAPS)
    if taps <= 1:
        return brightness(texture, x, y, max(short_m, 0.7 * long_m), 0.0, 0.0, 1)
    return brightness(texture, x, y, max(short_m, 0.7 * long_m / taps), ax, ay, taps)


@compiled
def ground_light(
    grid: Grid,
    broad: Texture,
    detail: Texture,
    ix: int,
    iy: int,
    x: float,
    y: float,
    s: float,
    dx: float,
    dy: float,
    de: float,
    pitch: float,
) -> float:
    """Brightness of a ground point seen from s metres with a sample pitch of ``pitch`` radians.

    (x, y) counts from the inner grid's corner, so that its cells and the texels of ``broad`` coincide.
    """
    inv = 0.5 / grid.cell_m
    h00 = grid.elevation_m[iy, ix]
    h10 = grid.elevation_m[iy, ix + 1]
    h01 = grid.elevation_m[iy + 1, ix]
    h11 = grid.elevation_m[iy + 1, ix + 1]
    sx = (h10 - h00 + h11 - h01) * inv
    sy = (h01 - h00 + h11 - h10) * inv
    norm = 1.0 / math.sqrt(1.0 + sx * sx + sy * sy)
    facing = max((sx * dx + sy * dy - de) * norm, 0.03)  # cosine between ray and the normal (-sx, -sy, 1)
    short = s * pitch
    flat = math.sqrt(dx * dx + dy * dy)
    stretch = short / facing / flat if flat > 1e-6 else 0.0
    if stretch < short:
        stretch = 0.0
    tone = stretched_brightness(broad, x, y, short, stretch * dx, stretch * dy)
    if short < 0.1:
        tone *= stretched_brightness(detail, x, y, short, stretch * dx, stretch * dy)
    haze = s / (s + HAZE_M)
    return GROUND_TONE * tone * (1.0 - haze) + SKY_HORIZON * haze


@compiled
def rock_light(
    rocks: Rocks,
    texture: Texture,
    sun: Float64,
    k: int,
    t: int,
    u: float,
    v: float,
    x: float,
    y: float,
    z: float,
    s: float,
    dx: float,
    dy: float,
    dz: float,
    pitch: float,
) -> float:
    """Brightness of a point of a rock: stone texture laid on from three sides, sun on the bent normal."""
    w = 1.0 - u - v
    normals = rocks.normals
    nx = w * normals[k, t, 0, 0] + u * normals[k, t, 1, 0] + v * normals[k, t, 2, 0]
    ny = w * normals[k, t, 0, 1] + u * normals[k, t, 1, 1] + v * normals[k, t, 2, 1]
    nz = w * normals[k, t, 0, 2] + u * normals[k, t, 1, 2] + v * normals[k, t, 2, 2]
    inv = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
    nx, ny, nz = nx * inv, ny * inv, nz * inv
    facing = max(-(nx * dx + ny * dy + nz * dz), 0.25)
    width = s * pitch / math.sqrt(facing)
    lx, ly, lz = (
        x - rocks.spheres_m[k, 0],
        y - rocks.spheres_m[k, 1],
        z - rocks.spheres_m[k, 2],
    )
    shift = 0.37 * k
    wx, wy, wz = nx * nx, ny * ny, nz * nz
    wx, wy, wz = wx * wx, wy * wy, wz * wz
    total = wx + wy + wz
    tone = 0.0
    if wx > 0.01 * total:
        tone += wx * brightness(texture, ly + shift, lz, width, 0.0, 0.0, 1)
    if wy > 0.01 * total:
        tone += wy * brightness(texture, lx + shift, lz, width, 0.0, 0.0, 1)
    if wz > 0.01 * total:
        tone += wz * brightness(texture, lx + shift, ly, width, 0.0, 0.0, 1)
    tone /= total
    light = max(float(nx * sun[0] + ny * sun[1] + nz * sun[2]), 0.0)
    above = 0.5 - 0.5 * nz
    tone *= float(rocks.tones[k]) * (AMBIENT * (0.45 + 0.55 * above) + (1.0 - AMBIENT) * light) * 1.45
    haze = s / (s + HAZE_M)
    return float(ROCK_TONE * tone * (1.0 - haze) + SKY_HORIZON * haze)


@compiled
def sky_light(de: float) -> float:
    """Brightness of the sky in a direction with upward part ``de``."""
    up = max(de, 0.0)
    return SKY_ZENITH + (SKY_HORIZON - SKY_ZENITH) * math.exp(-3.0 * up)


# ---------------------------------------------------------------- entries


@inlined
def turned(r: Float64, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Rotation matrix times vector."""
    return (
        r[0, 0] * x + r[0, 1] * y + r[0, 2] * z,
        r[1, 0] * x + r[1, 1] * y + r[1, 2] * z,
        r[2, 0] * x + r[2, 1] * y + r[2, 2] * z,
    )


@compiled
def cast_rays(world: World, origins_m: Float64, directions: Float64, ranges_m: Float64) -> None:
    """Fill ranges_m (n,) with the distance to the first thing met, not-a-number for none."""
    inner, outer, rocks = borrowed_grid(world.inner), borrowed_grid(world.outer), borrowed_rocks(world.rocks)
    for k in range(origins_m.shape[0]):
        ox, oy, oz = origins_m[k, 0], origins_m[k, 1], origins_m[k, 2]
        dx, dy, dz = directions[k, 0], directions[k, 1], directions[k, 2]
        s, _ix, _iy = cross_grid(inner, ox, oy, -oz, dx, dy, -dz, 0.0, FAR)
        if s >= FAR:
            s, _ix, _iy = cross_outer(inner, outer, ox, oy, -oz, dx, dy, -dz)
        for rock in range(rocks.spheres_m.shape[0]):
            if meets_ball(rocks.spheres_m, rock, ox, oy, oz, dx, dy, dz, s):
                met = cross_rock(rocks, rock, ox, oy, oz, dx, dy, dz, s)
                s = min(s, met[0])
        ranges_m[k] = s if 0.0 < s < FAR else np.nan


@compiled
def shadow_rays(rocks: Rocks, sun: Float64, points_m: Float64, clear: Float32) -> None:
    """Fill clear (n,) with 0 where a rock stands between a point and the sun, 1 elsewhere."""
    rocks, sun = borrowed_rocks(rocks), borrowed(sun)
    for k in range(points_m.shape[0]):
        x, y, z = points_m[k, 0], points_m[k, 1], points_m[k, 2]
        clear[k] = 1.0
        for rock in range(rocks.spheres_m.shape[0]):
            if meets_ball(rocks.spheres_m, rock, x, y, z, sun[0], sun[1], sun[2], FAR):
                met = cross_rock(rocks, rock, x, y, z, sun[0], sun[1], sun[2], FAR)
                if met[0] < FAR:
                    clear[k] = 0.0
                    break


@compiled
def rocks_in_beam(
    balls: Float64,
    cx: float,
    cy: float,
    cz: float,
    dx: float,
    dy: float,
    dz: float,
    spread: float,
    rho: float,
    near: Int64,
) -> int:
    """Fill ``near`` with the balls that a ray of a beam from (cx, cy, cz) may meet; return how many."""
    found = 0
    for k in range(balls.shape[0]):
        x, y, z = balls[k, 0] - cx, balls[k, 1] - cy, balls[k, 2] - cz
        along = x * dx + y * dy + z * dz
        distance2 = x * x + y * y + z * z
        radius = balls[k, 3] + rho
        reach = radius + (math.sqrt(distance2) + radius) * spread
        if along > -reach and distance2 - along * along < reach * reach:
            near[found] = k
            found += 1
    return found


@compiled
def render_tiles(
    world: World,
    rays: Float32,
    starts: Float32,
    tile_beams: Float64,
    block_beams: Float64,
    tile: int,
    block: int,
    first: int,
    last: int,
    rotation: Float64,
    centre_m: Float64,
    image: Float32,
) -> None:
    """Draw tiles ``first`` to ``last`` (row-major) of ``tile`` x ``tile`` pixels into image (h, w).

    rays (h, w, q, 3) are unit directions in the camera's mounting frame, q samples a pixel, not-a-number
    where there is none; starts (h, w, q, 3) are where each ray begins relative to C, or (0, 0, 0, 3) when all
    begin there. Beams (rows, columns, 6) hold the rays of each tile and of each block in it: axis (3) in the
    mounting frame, spread and start radius (see ``clear_distance``), angle between neighbouring samples in
    radians. rotation (3, 3) turns the mounting frame into the site frame, and centre_m (3,) is C there.
    """
    height, width, q = rays.shape[0], rays.shape[1], rays.shape[2]
    inner, outer, rocks = borrowed_grid(world.inner), borrowed_grid(world.outer), borrowed_rocks(world.rocks)
    broad, detail = borrowed_texture(world.broad), borrowed_texture(world.detail)
    stone, sun = borrowed_texture(world.stone), borrowed(world.sun)
    near = np.empty(rocks.spheres_m.shape[0], np.int64)
    r = rotation
    mx, my, mz = centre_m[0], centre_m[1], centre_m[2]
    per_tile = tile // block
    for index in range(first, last):
        row, column = index // tile_beams.shape[1], index % tile_beams.shape[1]
        tx, ty, tz, spread, rho, _ = tile_beams[row, column]
        if not spread >= 0.0:  # no ray in this tile
            continue
        bx, by, bz = turned(r, tx, ty, tz)
        tile_clear = clear_distance(inner, mx, my, -mz, bx, by, -bz, spread, rho, 0.0, 1.0)
        n_near = rocks_in_beam(rocks.spheres_m, mx, my, mz, bx, by, bz, spread, rho, near)
        for part in range(per_tile * per_tile):
            block_row, block_column = row * per_tile + part // per_tile, column * per_tile + part % per_tile
            if block_row >= block_beams.shape[0] or block_column >= block_beams.shape[1]:
                continue
            tx, ty, tz, spread, rho, pitch = block_beams[block_row, block_column]
            if not spread >= 0.0:
                continue
            bx, by, bz = turned(r, tx, ty, tz)
            clear = clear_distance(
                inner, mx, my, -mz, bx, by, -bz, spread, rho, tile_clear, 8.0 * (rho + tile_clear * spread)
            )
            for y in range(block_row * block, min(block_row * block + block, height)):
                for x in range(block_column * block, min(block_column * block + block, width)):
                    total = 0.0
                    rays_met = 0
                    for i in range(q):
                        if rays[y, x, i, 0] != rays[y, x, i, 0]:
                            continue
                        dx, dy, dz = turned(r, rays[y, x, i, 0], rays[y, x, i, 1], rays[y, x, i, 2])
                        ox, oy, oz = mx, my, mz
                        if starts.shape[0] > 0:
                            sx, sy, sz = turned(r, starts[y, x, i, 0], starts[y, x, i, 1], starts[y, x, i, 2])
                            ox, oy, oz = mx + sx, my + sy, mz + sz
                        s, ix, iy = cross_grid(inner, ox, oy, -oz, dx, dy, -dz, clear, FAR)
                        beyond = s >= FAR
                        if beyond:
                            s, ix, iy = cross_outer(inner, outer, ox, oy, -oz, dx, dy, -dz)
                        rock, triangle, u, v = NOTHING, NOTHING, 0.0, 0.0
                        for j in range(n_near):
                            k = near[j]
                            if meets_ball(rocks.spheres_m, k, ox, oy, oz, dx, dy, dz, s):
                                met_s, met_t, met_u, met_v = cross_rock(rocks, k, ox, oy, oz, dx, dy, dz, s)
                                if met_s < s:
                                    s, rock, triangle, u, v = met_s, k, met_t, met_u, met_v
                        px, py, pz = ox + s * dx, oy + s * dy, oz + s * dz
                        if rock != NOTHING:
                            total += rock_light(
                                rocks, stone, sun, rock, triangle, u, v, px, py, pz, s, dx, dy, dz, pitch
                            )
                        elif s < FAR:
                            grid = outer if beyond else inner
                            px, py = px - inner.x0_m, py - inner.y0_m
                            total += ground_light(grid, broad, detail, ix, iy, px, py, s, dx, dy, -dz, pitch)
                        else:
                            total += sky_light(-dz)
                        rays_met += 1
                    if rays_met > 0:
                        image[y, x] = min(total / rays_met, 255.0)


# ---------------------------------------------------------------- gravel


@compiled
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
