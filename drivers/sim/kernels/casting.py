"""Single rays: how far they go, and whether they reach the sun."""

from __future__ import annotations

import numpy as np

from drivers.sim.kernels.compiling import entry
from drivers.sim.kernels.ground import cross_grid, cross_outer
from drivers.sim.kernels.stones import cross_rock, meets_ball
from drivers.sim.kernels.world import (
    FAR,
    Float32,
    Float64,
    Rocks,
    World,
    borrowed,
    borrowed_grid,
    borrowed_rocks,
)


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
