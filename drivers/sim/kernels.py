"""The compiled heart of the renderer: rays against ground and rocks, the light that comes back, noise.

All compiled functions are in this one file, since numba's cache on disk compares only the file of the
function that Python calls. Heights inside are *elevations*, up positive (site z is down): e = -z. Lengths
along a ray are metres because directions are unit vectors. Geometry is float64.
Importing this module raises BadOptions if numba is not installed.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from drivers.errors import BadOptions

try:
    import numba
    from numba.core import cgutils, types
    from numba.extending import intrinsic
except ModuleNotFoundError as missing:
    raise BadOptions("the simulated rover needs numba: pip install 'mastctl[sim]'") from missing

log = logging.getLogger(__name__)

Function = TypeVar("Function", bound=Callable[..., Any])
Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]

_ALL: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
_INSIDE = {
    **_ALL,
    "no_cpython_wrapper": True,
}  # packing and unpacking a world is much code that nothing calls


def entry(function: Function) -> Function:
    """Compile a function that Python calls, without the interpreter lock; kept on disk where numba can."""
    try:
        return cast(Function, numba.njit(cache=True, **_ALL)(function))
    except RuntimeError as error:  # neither beside this file nor in the user's cache
        log.warning("the simulator compiles at every start (%s); NUMBA_CACHE_DIR names another folder", error)
        return cast(Function, numba.njit(**_ALL)(function))


def part(function: Function) -> Function:
    """Compile a function that only other compiled functions call."""
    return cast(Function, numba.njit(**_INSIDE)(function))


def inlined(function: Function) -> Function:
    """Compile into the callers."""
    return cast(Function, numba.njit(**_INSIDE, forceinline=True)(function))


FAR = 1e30
NOTHING = -1
ONE = 16384.0  # the texel value that means brightness 1
PAD = 32  # not one: rows a power of two apart would share one place in the cache
AMBIENT = 0.30


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
    spheres (k, 4) is (centre, radius); corners_m (k, 1280, 3, 3); normals (k, 1280, 3, 3), at the
    corners.
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
    (i + 0.5) 2**k: levels lie exactly on each other. Behind each row and each level the first texels come
    again, ``PAD`` of them and one row. Values are relative brightness times ``ONE``.
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


class Ray(NamedTuple):
    """A point and a unit direction in the site frame (z down), unless a function says otherwise."""

    x: float
    y: float
    z: float
    dx: float
    dy: float
    dz: float


class Meeting(NamedTuple):
    """Where a ray meets a rock: metres, rock, triangle, weights of its corners 1 and 2; NOTHING: no rock."""

    s: float
    rock: int
    triangle: int
    u: float
    v: float


def _borrowed(_context: Any, value: Any) -> Any:
    """Return an array, or tuples of arrays, without owners, so that passing it on counts no references.

    The counts are atomic: with them a picture takes two to three times as long. The caller keeps the owner.
    """

    def without_owner(context: Any, builder: Any, kind: Any, part: Any) -> Any:
        if isinstance(kind, numba_types.BaseTuple):
            for index, inside in enumerate(kind.types):
                freed = without_owner(context, builder, inside, builder.extract_value(part, index))
                part = builder.insert_value(part, freed, index)
        elif isinstance(kind, numba_types.Array):
            proxy = numba_structs.create_struct_proxy(kind)(context, builder, value=part)
            proxy.meminfo = numba_structs.get_null_value(proxy.meminfo.type)
            part = proxy._getvalue()
        return part

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return without_owner(context, builder, signature.return_type, arguments[0])

    return value(value), generate


numba_structs: Any = cgutils
numba_types: Any = types
borrowed = cast(Callable[[Any], Any], intrinsic(_borrowed))


# Rays and beams of rays against a heightfield of triangles, one by one or a block of pixels together.
#
# A `walk` takes each ray through the cells by itself. Neighbouring rays meet the same few triangles, so in a
# `sweep` each triangle is read once and tried on all rays, by a loop that becomes vector instructions. Rays
# that meet nothing within a budget walk on from where the sweep ended.

SIGHT_M = 2000.0  # beams are followed no farther

BUDGET = 32  # cells, and one more a ray, that are tried before the rest walks on
LEVEL_PART = 0.1  # a bundle that goes less than this to the side for each metre is left to the walk
OVERLAP = 1e-9  # of a cell: triangles overlap rather than leave a gap

DX, DY, DE, MET_A, MET_B = 0, 1, 2, 3, 4
"""Rows of a bundle (5, n) of rays from one point. Directions are in metres, not-a-number where there is none.
What a ray met, it met at met_a / met_b metres; met_b is 0 as long as it met nothing."""


@inlined
def in_cells(grid: Grid, ray: Ray) -> Ray:
    """Return a ray with x and y in cells of the grid, as the walk goes."""
    scale = 1.0 / grid.cell_m
    x, y = (ray.x - grid.x0_m) * scale, (ray.y - grid.y0_m) * scale
    return Ray(x, y, ray.z, ray.dx * scale, ray.dy * scale, ray.dz)


@inlined
def cell_crossing(grid: Grid, ix: int, iy: int, ray: Ray, s0: float, s1: float) -> float:
    """Where between s0 and s1 a ray in cells enters cell (ix, iy), FAR if nowhere."""
    px, py, e, dx, dy, de = ray.x, ray.y, -ray.z, ray.dx, ray.dy, -ray.dz
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
def walk(grid: Grid, ray: Ray, start: float, end: float) -> tuple[float, int, int]:
    """First crossing from above of a ray in cells between ``start``, over the grid, and ``end``.

    Goes from block to block of cells, skipping one when the ray stays above its highest corner.
    """
    px, py, e, dx, dy, de = ray.x, ray.y, -ray.z, ray.dx, ray.dy, -ray.dz
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
            hit = cell_crossing(grid, ix, iy, ray, s, s_out)
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
def cross_grid(grid: Grid, ray: Ray, start: float, end: float) -> tuple[float, int, int]:
    """First crossing from above of a ray with the grid between ``start`` and ``end`` metres: (s, ix, iy).

    s is FAR for a miss. The ray may begin and end outside the grid.
    """
    oe, de = -ray.z, -ray.dz
    if de >= 0.0 and oe > grid.highest_m:
        return FAR, 0, 0
    if de > 0.0:
        end = min(end, (grid.highest_m - oe) / de)
    elif de < 0.0:
        end = min(end, (grid.lowest_m - 1e-6 - oe) / de)
        start = max(start, (grid.highest_m + 1e-9 - oe) / de)
    n = grid.cells
    ray = in_cells(grid, ray)
    for p, d in ((ray.x, ray.dx), (ray.y, ray.dy)):
        if d != 0.0:
            near, far = -p / d, (n - p) / d
            start, end = max(start, min(near, far)), min(end, max(near, far))
        elif p < 0.0 or p > n:
            return FAR, 0, 0
    if start >= end:
        return FAR, 0, 0
    return walk(grid, ray, start, end)


@inlined
def cross_from_inside(grid: Grid, ray: Ray, start: float) -> tuple[float, int, int]:
    """As `cross_grid`, for a ray that is over the grid at ``start``: the grid's sides are not tested."""
    end = FAR
    oe, de = -ray.z, -ray.dz
    if de >= 0.0:
        if oe + start * de > grid.highest_m:
            return FAR, 0, 0
        if de > 0.0:
            end = (grid.highest_m - oe) / de
    return walk(grid, in_cells(grid, ray), start, end)


@entry
def over_ground(grid: Grid, x: float, y: float, e: float) -> bool:
    """Whether a point is over the grid's square and above its triangles."""
    ray = in_cells(grid, Ray(x, y, -e, 0.0, 0.0, 0.0))
    if not (0.0 <= ray.x < grid.cells and 0.0 <= ray.y < grid.cells):
        return False
    return cell_crossing(grid, int(ray.x), int(ray.y), ray, 0.0, 0.0) == FAR


@part
def cross_outer(inner: Grid, outer: Grid, ray: Ray, start: float) -> tuple[float, int, int]:
    """First crossing with the outer grid, after ``start`` and after leaving the inner one's square."""
    half = inner.cells * inner.cell_m * 0.5
    leave = FAR
    if ray.dx != 0.0:
        leave = min(leave, (inner.x0_m + half + math.copysign(half, ray.dx) - ray.x) / ray.dx)
    if ray.dy != 0.0:
        leave = min(leave, (inner.y0_m + half + math.copysign(half, ray.dy) - ray.y) / ray.dy)
    return cross_grid(outer, ray, max(leave, start), FAR)


@part
def clear_distance(grid: Grid, ray: Ray, spread: float, rho: float, start: float, step: float) -> float:
    """How far a whole beam of rays is clear of the ground, from below rather than above.

    Every ray of the beam keeps within rho + s * spread of the central ray's point at s. Begins at ``start``,
    known to be clear, with steps of ``step`` metres; stops at the edge of the grid.
    """
    ox, oy, oe, dx, dy, de = ray.x, ray.y, -ray.z, ray.dx, ray.dy, -ray.dz
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


# Rays against rocks; single rays: how far they go, and whether they reach the sun.


@inlined
def meets_box(boxes: Float64, k: int, i: int, ray: Ray, limit: float) -> bool:
    """Whether a ray, its direction given as 1 / direction, meets box i of rock k before ``limit``."""
    ox, oy, oz, ix, iy, iz = ray
    a, b = (boxes[k, i, 0] - ox) * ix, (boxes[k, i, 3] - ox) * ix
    near, far = min(a, b), max(a, b)
    a, b = (boxes[k, i, 1] - oy) * iy, (boxes[k, i, 4] - oy) * iy
    near, far = max(near, min(a, b)), min(far, max(a, b))
    a, b = (boxes[k, i, 2] - oz) * iz, (boxes[k, i, 5] - oz) * iz
    near, far = max(near, min(a, b)), min(far, max(a, b))
    return bool(far >= max(near, 0.0) and near < limit)


@inlined
def meets_triangle(corners: Float64, k: int, t: int, ray: Ray) -> tuple[float, float, float]:
    """Möller and Trumbore's test: (s, weight of corner 1, weight of corner 2); s is FAR for a miss."""
    ox, oy, oz, dx, dy, dz = ray
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


@inlined
def meets_ball(balls: Float64, k: int, ray: Ray, limit: float) -> bool:
    """Whether a ray meets ball k of (centre, radius) before ``limit``."""
    ox, oy, oz, dx, dy, dz = ray
    cx, cy, cz, radius = balls[k, 0] - ox, balls[k, 1] - oy, balls[k, 2] - oz, balls[k, 3]
    along = cx * dx + cy * dy + cz * dz
    rest = radius * radius - (cx * cx + cy * cy + cz * cz - along * along)
    if rest < 0.0:
        return False
    reach = math.sqrt(rest)
    return bool(along + reach > 0.0 and along - reach < limit)


@part
def cross_rock(rocks: Rocks, k: int, ray: Ray, limit: float) -> tuple[float, int, float, float]:
    """First meeting with rock k before ``limit``: (s, triangle, weights); s is FAR for a miss."""
    best, triangle, best_u, best_v = limit, NOTHING, 0.0, 0.0
    ix = 1.0 / ray.dx if ray.dx != 0.0 else FAR
    iy = 1.0 / ray.dy if ray.dy != 0.0 else FAR
    iz = 1.0 / ray.dz if ray.dz != 0.0 else FAR
    inverse = Ray(ray.x, ray.y, ray.z, ix, iy, iz)
    for a in range(20):
        if not meets_box(rocks.boxes_a, k, a, inverse, best):
            continue
        for b in range(4 * a, 4 * a + 4):
            if not meets_box(rocks.boxes_b, k, b, inverse, best):
                continue
            for c in range(4 * b, 4 * b + 4):
                if not meets_box(rocks.boxes_c, k, c, inverse, best):
                    continue
                for t in range(4 * c, 4 * c + 4):
                    s, u, v = meets_triangle(rocks.corners_m, k, t, ray)
                    if s < best:
                        best, triangle, best_u, best_v = s, t, u, v
    if triangle == NOTHING:
        return FAR, NOTHING, 0.0, 0.0
    return best, triangle, best_u, best_v


@inlined
def in_beam(balls: Float64, k: int, ray: Ray, spread: float, rho: float) -> bool:
    """Whether a ray of a beam about ``ray``, see `clear_distance`, may meet ball k."""
    x, y, z = balls[k, 0] - ray.x, balls[k, 1] - ray.y, balls[k, 2] - ray.z
    along = x * ray.dx + y * ray.dy + z * ray.dz
    distance2 = x * x + y * y + z * z
    radius = balls[k, 3] + rho
    reach = radius + (math.sqrt(distance2) + radius) * spread
    return bool(along > -reach and distance2 - along * along < reach * reach)


@part
def nearest_rock(rocks: Rocks, near: Int64, count: int, ray: Ray, limit: float) -> Meeting:
    """First meeting with one of ``count`` rocks before ``limit``."""
    s, rock, triangle, u, v = limit, NOTHING, NOTHING, 0.0, 0.0
    for j in range(count):
        k = near[j]
        if meets_ball(rocks.spheres_m, k, ray, s):
            met_s, met_t, met_u, met_v = cross_rock(rocks, k, ray, s)
            if met_s < s:
                s, rock, triangle, u, v = met_s, k, met_t, met_u, met_v
    return Meeting(s, rock, triangle, u, v)


@entry
def cast_rays(world: World, origins_m: Float64, directions: Float64, ranges_m: Float64) -> None:
    """Fill ranges_m (n,) with the distance to the first thing met, not-a-number for none."""
    world = borrowed(world)
    rocks = world.rocks
    for k in range(origins_m.shape[0]):
        ray = Ray(
            origins_m[k, 0], origins_m[k, 1], origins_m[k, 2],
            directions[k, 0], directions[k, 1], directions[k, 2],
        )  # fmt: skip
        s, _ix, _iy = cross_grid(world.inner, ray, 0.0, FAR)
        if s >= FAR:
            s, _ix, _iy = cross_outer(world.inner, world.outer, ray, 0.0)
        for rock in range(rocks.spheres_m.shape[0]):
            if meets_ball(rocks.spheres_m, rock, ray, s):
                s = min(s, cross_rock(rocks, rock, ray, s)[0])
        ranges_m[k] = s if 0.0 < s < FAR else np.nan


@entry
def shadow_rays(rocks: Rocks, sun: Float64, points_m: Float64, clear: Float32) -> None:
    """Fill clear (n,) with 0 where a rock stands between a point and the sun, 1 elsewhere."""
    rocks, sun = borrowed(rocks), borrowed(sun)
    for k in range(points_m.shape[0]):
        ray = Ray(points_m[k, 0], points_m[k, 1], points_m[k, 2], sun[0], sun[1], sun[2])
        clear[k] = 1.0
        for rock in range(rocks.spheres_m.shape[0]):
            if meets_ball(rocks.spheres_m, rock, ray, FAR) and cross_rock(rocks, rock, ray, FAR)[0] < FAR:
                clear[k] = 0.0
                break


# The light that comes back from ground, rocks and sky, by textures over the footprint of a ray.

MAX_TAPS = 12

GROUND_TONE = 108.0
ROCK_TONE = 106.0
SKY_HORIZON = 196.0
SKY_ZENITH = 128.0
HAZE_M = 900.0


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


@inlined
def ground_light(
    grid: Grid, broad: Texture, detail: Texture, ix: int, iy: int, ray: Ray, s: float, pitch: float
) -> float:
    """Brightness of a ground point seen from s metres with a sample pitch of ``pitch`` radians.

    The ray is at the point. Its (x, y) counts from the inner grid's corner, so that its cells and the texels
    of ``broad`` coincide.
    """
    x, y, dx, dy = ray.x, ray.y, ray.dx, ray.dy
    inv = 0.5 / grid.cell_m
    h00 = grid.elevation_m[iy, ix]
    h10 = grid.elevation_m[iy, ix + 1]
    h01 = grid.elevation_m[iy + 1, ix]
    h11 = grid.elevation_m[iy + 1, ix + 1]
    sx = (h10 - h00 + h11 - h01) * inv
    sy = (h01 - h00 + h11 - h10) * inv
    norm = 1.0 / math.sqrt(1.0 + sx * sx + sy * sy)
    facing = max((sx * dx + sy * dy + ray.dz) * norm, 0.03)  # cosine between ray and the normal (-sx, -sy, 1)
    short = s * pitch
    long = short / facing
    level = 1.0 / math.sqrt(dx * dx + dy * dy + 1e-12)
    ux, uy = dx * level, dy * level
    tone = stretched_brightness(broad, x, y, short, long, ux, uy)
    if short < 0.1:
        tone *= stretched_brightness(detail, x, y, short, long, ux, uy)
    haze = s / (s + HAZE_M)
    return float(GROUND_TONE * tone * (1.0 - haze) + SKY_HORIZON * haze)


@part
def hits_light(
    world: World, hits: Float64, count: int, together: bool, pitch: float, wide_pitch: float
) -> float:
    """Sum of the brightness of ``count`` hits of one pixel on the ground (n, 6: x, y, s, dx, dy, dz).

    ``together`` looks the texture up once for all of them, at their middle and with the pixel's own pitch.
    """
    grid = world.inner
    last = grid.cells - 1
    inv_cell = 1.0 / grid.cell_m
    looks, share = count, 1.0
    if together:
        for i in range(6):
            total = 0.0
            for k in range(count):
                total += hits[k, i]
            hits[0, i] = total / count
        looks, share, pitch = 1, float(count), wide_pitch
    total = 0.0
    for k in range(looks):
        x, y = hits[k, 0], hits[k, 1]
        ix, iy = min(int(x * inv_cell), last), min(int(y * inv_cell), last)
        ray = Ray(x, y, 0.0, hits[k, 3], hits[k, 4], hits[k, 5])
        total += ground_light(grid, world.broad, world.detail, ix, iy, ray, hits[k, 2], pitch)
    return total * share


@part
def rock_light(rocks: Rocks, texture: Texture, sun: Float64, met: Meeting, ray: Ray, pitch: float) -> float:
    """Brightness of a point of a rock: stone texture laid on from three sides, sun on the bent normal."""
    s, k, t, u, v = met
    x, y, z = ray.x + s * ray.dx, ray.y + s * ray.dy, ray.z + s * ray.dz
    w = 1.0 - u - v
    normals = rocks.normals
    nx = w * normals[k, t, 0, 0] + u * normals[k, t, 1, 0] + v * normals[k, t, 2, 0]
    ny = w * normals[k, t, 0, 1] + u * normals[k, t, 1, 1] + v * normals[k, t, 2, 1]
    nz = w * normals[k, t, 0, 2] + u * normals[k, t, 1, 2] + v * normals[k, t, 2, 2]
    inv = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
    nx, ny, nz = nx * inv, ny * inv, nz * inv
    facing = max(-(nx * ray.dx + ny * ray.dy + nz * ray.dz), 0.25)
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


@inlined
def sky_light(de: float) -> float:
    """Brightness of the sky in a direction with upward part ``de``."""
    up = max(de, 0.0)
    return SKY_ZENITH + (SKY_HORIZON - SKY_ZENITH) * math.exp(-3.0 * up)


# Whole pictures: pebbles painted over sand, and noise that machines agree on to the bit.


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


# Beams that hold the rays of squares of pixels, made once a camera; and pictures, tile by tile.

ROUNDING = 1e-6  # of float32 directions and metres

SHARING = 4  # up to so many rays of a pixel share one look at the ground's texture...
ONE_PATCH = 1.05  # ...if the farthest hit is no farther than this times the nearest


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


class RayView(NamedTuple):
    """A camera's rays, and where it stands: see `render_tiles`."""

    rays: Float32
    starts: Float32
    rotation: Float64
    centre_m: Float64


class PixelBlock(NamedTuple):
    """What holds for all rays of a block of pixels.

    No ray meets the inner ground before ``clear_m``, but where the sweep has found it, the outer one before
    ``clear_beyond_m``, or rocks but the first ``n_near`` of a list. ``pitch`` radians lie between samples.
    """

    clear_m: float
    clear_beyond_m: float
    n_near: int
    pitch: float


@inlined
def turned(r: Float64, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Rotation matrix times vector."""
    return (
        r[0, 0] * x + r[0, 1] * y + r[0, 2] * z,
        r[1, 0] * x + r[1, 1] * y + r[1, 2] * z,
        r[2, 0] * x + r[2, 1] * y + r[2, 2] * z,
    )


@inlined
def take_rays(view: RayView, bundle: Float64, y0: int, y1: int, x0: int, x1: int) -> int:
    """Fill the bundle with the rays of the pixels [y0, y1) x [x0, x1), in the site frame; return how many."""
    rays, r = view.rays, view.rotation
    n = 0
    for y in range(y0, y1):
        for x in range(x0, x1):
            for i in range(rays.shape[2]):
                dx, dy, dz = turned(r, rays[y, x, i, 0], rays[y, x, i, 1], rays[y, x, i, 2])
                bundle[DX, n], bundle[DY, n], bundle[DE, n] = dx, dy, -dz
                # a ray that is none has met something behind everything: nobody waits for it
                bundle[MET_A, n], bundle[MET_B, n] = (1.0, 0.0) if dx == dx else (-1.0, 1.0)
                n += 1
    return n


@inlined
def pixel_light(
    world: World,
    view: RayView,
    block: PixelBlock,
    bundle: Float64,
    first: int,
    near: Int64,
    hits: Float64,
    y: int,
    x: int,
    rays_shared: bool,
) -> float:
    """Mean brightness that a pixel's rays, from ``first`` in the bundle, bring back; nan if it has none."""
    inner, outer = world.inner, world.outer
    q = view.rays.shape[2]
    total, rays_met, grounded, nearest, farthest = 0.0, 0, 0, FAR, 0.0
    for i in range(q):
        dx, dy, dz = bundle[DX, first + i], bundle[DY, first + i], -bundle[DE, first + i]
        if dx != dx:
            continue
        ox, oy, oz = view.centre_m[0], view.centre_m[1], view.centre_m[2]
        if view.starts.shape[0] > 0:
            starts = view.starts
            sx, sy, sz = turned(view.rotation, starts[y, x, i, 0], starts[y, x, i, 1], starts[y, x, i, 2])
            ox, oy, oz = ox + sx, oy + sy, oz + sz
            if not over_ground(inner, ox, oy, -oz):
                continue
        rays_met += 1
        ray = Ray(ox, oy, oz, dx, dy, dz)
        ix, iy = 0, 0
        if bundle[MET_B, first + i] > 0.0:
            s = bundle[MET_A, first + i] / bundle[MET_B, first + i]
        else:
            s, ix, iy = cross_from_inside(inner, ray, block.clear_m)
        beyond = s >= FAR
        if beyond:
            s, ix, iy = cross_outer(inner, outer, ray, block.clear_beyond_m)
        if block.n_near > 0:
            met = nearest_rock(world.rocks, near, block.n_near, ray, s)
            if met.rock != NOTHING:
                total += rock_light(world.rocks, world.stone, world.sun, met, ray, block.pitch)
                continue
        if s >= FAR:
            total += sky_light(-dz)
            continue
        px, py = ox + s * dx - inner.x0_m, oy + s * dy - inner.y0_m
        if beyond:
            there = Ray(px, py, 0.0, dx, dy, dz)
            total += ground_light(outer, world.broad, world.detail, ix, iy, there, s, block.pitch)
            continue
        hits[grounded, 0], hits[grounded, 1], hits[grounded, 2] = px, py, s
        hits[grounded, 3], hits[grounded, 4], hits[grounded, 5] = dx, dy, dz
        nearest, farthest = min(nearest, s), max(farthest, s)
        grounded += 1
    if grounded > 0:
        together = rays_shared and farthest < nearest * ONE_PATCH
        wide = block.pitch * math.sqrt(q)
        total += hits_light(world, hits, grounded, together, block.pitch, wide)
    return total / rays_met if rays_met > 0 else math.nan


@entry
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
    scratch: Float64,
    image: Float32,
) -> None:
    """Draw tiles ``first`` to ``last`` (row-major) of ``tile`` x ``tile`` pixels into image (h, w).

    rays (h, w, q, 3) are unit directions in the camera's mounting frame, q samples a pixel, not-a-number
    where there is none; starts (h, w, q, 3) are where each ray begins relative to C, or (0, 0, 0, 3) when all
    begin there. Beams (rows, columns, 6) hold the rays of each tile and of each block in it: axis (3) in the
    mounting frame, spread and start radius (see ``clear_distance``), angle between neighbouring samples in
    radians. rotation (3, 3) turns the mounting frame into the site frame, and centre_m (3,) is C there.
    scratch (5, block * block * q) is written over.
    """
    world = borrowed(world)
    view = RayView(borrowed(rays), borrowed(starts), borrowed(rotation), borrowed(centre_m))
    height, width, q = rays.shape[0], rays.shape[1], rays.shape[2]
    inner, balls = world.inner, world.rocks.spheres_m
    in_tile, in_block = np.empty(balls.shape[0], np.int64), np.empty(balls.shape[0], np.int64)
    hits = np.empty((q, 6))
    bundle = borrowed(scratch)
    mx, my, mz = centre_m[0], centre_m[1], centre_m[2]
    per_tile = tile // block
    half = 0.5 * inner.cells * inner.cell_m
    off_centre = max(abs(mx - inner.x0_m - half), abs(my - inner.y0_m - half))
    near_edge = max(half - off_centre - 1.0, 0.0)  # a beam that is clear so far may leave the inner grid
    for index in range(first, last):
        row, column = index // tile_beams.shape[1], index % tile_beams.shape[1]
        tx, ty, tz, spread, rho, _ = tile_beams[row, column]
        if not spread >= 0.0:  # no ray in this tile
            continue
        bx, by, bz = turned(rotation, tx, ty, tz)
        beam = Ray(mx, my, mz, bx, by, bz)
        tile_clear = clear_distance(inner, beam, spread, rho, 0.0, 1.0)
        n_tile = 0
        for k in range(balls.shape[0]):
            if in_beam(balls, k, beam, spread, rho):
                in_tile[n_tile] = k
                n_tile += 1
        for part_of_tile in range(per_tile * per_tile):
            j, i = row * per_tile + part_of_tile // per_tile, column * per_tile + part_of_tile % per_tile
            if j >= block_beams.shape[0] or i >= block_beams.shape[1]:
                continue
            tx, ty, tz, spread, rho, pitch = block_beams[j, i]
            if not spread >= 0.0:
                continue
            bx, by, bz = turned(rotation, tx, ty, tz)
            beam = Ray(mx, my, mz, bx, by, bz)
            step = 8.0 * (rho + tile_clear * spread)
            clear = clear_distance(inner, beam, spread, rho, tile_clear, step)
            beyond = 0.0
            if clear >= near_edge:
                beyond = clear_distance(world.outer, beam, spread, rho, near_edge, 8.0)
            n_block = 0
            for listed in range(n_tile):
                k = in_tile[listed]
                if in_beam(balls, k, beam, spread, rho):
                    in_block[n_block] = k
                    n_block += 1
            y1, x1 = min(j * block + block, height), min(i * block + block, width)
            count = take_rays(view, bundle, j * block, y1, i * block, x1)
            if starts.shape[0] == 0 and clear < FAR:
                clear = sweep(inner, bundle, count, mx, my, -mz, clear, abs(bx) > abs(by))
            place = PixelBlock(clear, beyond, n_block, pitch)
            y0, x0 = j * block, i * block
            for y in range(y0, y1):
                for x in range(x0, x1):
                    n = ((y - y0) * (x1 - x0) + x - x0) * q
                    light = pixel_light(world, view, place, bundle, n, in_block, hits, y, x, 1 < q <= SHARING)
                    if light == light:
                        image[y, x] = min(light, 255.0)
