"""Rays against rocks; single rays: how far they go, and whether they reach the sun."""

from __future__ import annotations

import math

import numpy as np

from drivers.sim.kernels.compiling import entry, inlined, part
from drivers.sim.kernels.ground import cross_grid, cross_outer
from drivers.sim.kernels.world import (
    FAR,
    NOTHING,
    Float32,
    Float64,
    Int64,
    Rocks,
    World,
    borrowed,
    borrowed_grid,
    borrowed_rocks,
)


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


@inlined
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


@part
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


@inlined
def in_beam(
    balls: Float64,
    k: int,
    cx: float,
    cy: float,
    cz: float,
    dx: float,
    dy: float,
    dz: float,
    spread: float,
    rho: float,
) -> bool:
    """Whether a ray of a beam from (cx, cy, cz), see `clear_distance`, may meet ball k."""
    x, y, z = balls[k, 0] - cx, balls[k, 1] - cy, balls[k, 2] - cz
    along = x * dx + y * dy + z * dz
    distance2 = x * x + y * y + z * z
    radius = balls[k, 3] + rho
    reach = radius + (math.sqrt(distance2) + radius) * spread
    return bool(along > -reach and distance2 - along * along < reach * reach)


@part
def nearest_rock(
    rocks: Rocks,
    near: Int64,
    count: int,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    limit: float,
) -> tuple[float, int, int, float, float]:
    """First meeting with one of ``count`` rocks before ``limit``: (s, rock, triangle, weights)."""
    s, rock, triangle, u, v = limit, NOTHING, NOTHING, 0.0, 0.0
    for j in range(count):
        k = near[j]
        if meets_ball(rocks.spheres_m, k, ox, oy, oz, dx, dy, dz, s):
            met_s, met_t, met_u, met_v = cross_rock(rocks, k, ox, oy, oz, dx, dy, dz, s)
            if met_s < s:
                s, rock, triangle, u, v = met_s, k, met_t, met_u, met_v
    return s, rock, triangle, u, v


@entry
def cast_rays(world: World, origins_m: Float64, directions: Float64, ranges_m: Float64) -> None:
    """Fill ranges_m (n,) with the distance to the first thing met, not-a-number for none."""
    inner, outer, rocks = borrowed_grid(world.inner), borrowed_grid(world.outer), borrowed_rocks(world.rocks)
    for k in range(origins_m.shape[0]):
        ox, oy, oz = origins_m[k, 0], origins_m[k, 1], origins_m[k, 2]
        dx, dy, dz = directions[k, 0], directions[k, 1], directions[k, 2]
        s, _ix, _iy = cross_grid(inner, ox, oy, -oz, dx, dy, -dz, 0.0, FAR)
        if s >= FAR:
            s, _ix, _iy = cross_outer(inner, outer, ox, oy, -oz, dx, dy, -dz, 0.0)
        for rock in range(rocks.spheres_m.shape[0]):
            if meets_ball(rocks.spheres_m, rock, ox, oy, oz, dx, dy, dz, s):
                met = cross_rock(rocks, rock, ox, oy, oz, dx, dy, dz, s)
                s = min(s, met[0])
        ranges_m[k] = s if 0.0 < s < FAR else np.nan


@entry
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
