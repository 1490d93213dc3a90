"""Beams that hold the rays of squares of pixels: made once a camera."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drivers.sim.kernels.casting import in_beam, nearest_rock
from drivers.sim.kernels.compiling import entry, inlined, part
from drivers.sim.kernels.ground import (
    DE,
    DX,
    DY,
    MET_A,
    MET_B,
    clear_distance,
    cross_from_inside,
    cross_outer,
    over_ground,
    sweep,
)
from drivers.sim.kernels.light import (
    board_light,
    ground_light,
    hits_light,
    rock_light,
    shows_board,
    sky_light,
)
from drivers.sim.kernels.world import (
    FAR,
    NOTHING,
    Float32,
    Float64,
    Int64,
    World,
    borrowed,
    borrowed_boards,
    borrowed_grid,
    borrowed_rocks,
    borrowed_texture,
)

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


@part
def borrowed_world(world: World) -> World:
    """The world without owners."""
    return World(
        borrowed_grid(world.inner),
        borrowed_grid(world.outer),
        borrowed_rocks(world.rocks),
        borrowed_texture(world.detail),
        borrowed_texture(world.broad),
        borrowed_texture(world.stone),
        borrowed_boards(world.boards),
        borrowed(world.sun),
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
        ix, iy = 0, 0
        if bundle[MET_B, first + i] > 0.0:
            s = bundle[MET_A, first + i] / bundle[MET_B, first + i]
        else:
            s, ix, iy = cross_from_inside(inner, ox, oy, -oz, dx, dy, -dz, block.clear_m)
        beyond = s >= FAR
        if beyond:
            s, ix, iy = cross_outer(inner, outer, ox, oy, -oz, dx, dy, -dz, block.clear_beyond_m)
        if block.n_near > 0:
            s, rock, triangle, u, v = nearest_rock(world.rocks, near, block.n_near, ox, oy, oz, dx, dy, dz, s)
            if rock != NOTHING:
                px, py, pz = ox + s * dx, oy + s * dy, oz + s * dz
                board = world.rocks.boards[rock]
                if board != NOTHING and shows_board(world.rocks, world.boards, rock, triangle, board):
                    total += board_light(
                        world.boards, board, world.sun, px, py, pz, s, dx, dy, dz, block.pitch
                    )
                    continue
                total += rock_light(
                    world.rocks, world.stone, world.sun, rock, triangle, u, v, px, py, pz, s, dx, dy, dz,
                    block.pitch,
                )  # fmt: skip
                continue
        if s >= FAR:
            total += sky_light(-dz)
            continue
        px, py = ox + s * dx - inner.x0_m, oy + s * dy - inner.y0_m
        if beyond:
            total += ground_light(
                outer, world.broad, world.detail, ix, iy, px, py, s, dx, dy, -dz, block.pitch
            )
            continue
        hits[grounded, 0], hits[grounded, 1], hits[grounded, 2] = px, py, s
        hits[grounded, 3], hits[grounded, 4], hits[grounded, 5] = dx, dy, -dz
        nearest, farthest = min(nearest, s), max(farthest, s)
        grounded += 1
    if grounded > 0:
        together = rays_shared and farthest < nearest * ONE_PATCH
        wide = block.pitch * math.sqrt(q)
        total += hits_light(inner, world.broad, world.detail, hits, grounded, together, block.pitch, wide)
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
    world = borrowed_world(world)
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
        tile_clear = clear_distance(inner, mx, my, -mz, bx, by, -bz, spread, rho, 0.0, 1.0)
        n_tile = 0
        for k in range(balls.shape[0]):
            if in_beam(balls, k, mx, my, mz, bx, by, bz, spread, rho):
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
            step = 8.0 * (rho + tile_clear * spread)
            clear = clear_distance(inner, mx, my, -mz, bx, by, -bz, spread, rho, tile_clear, step)
            beyond = 0.0
            if clear >= near_edge:
                beyond = clear_distance(world.outer, mx, my, -mz, bx, by, -bz, spread, rho, near_edge, 8.0)
            n_block = 0
            for listed in range(n_tile):
                k = in_tile[listed]
                if in_beam(balls, k, mx, my, mz, bx, by, bz, spread, rho):
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
