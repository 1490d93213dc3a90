"""The light that comes back from ground, rocks, boards and sky, by textures over the footprint of a ray."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from drivers.sim.kernels.compiling import inlined, part
from drivers.sim.kernels.world import AMBIENT, ONE, PAD, Boards, Float64, Grid, Rocks, Texture

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
    grid: Grid,
    broad: Texture,
    detail: Texture,
    hits: Float64,
    count: int,
    together: bool,
    pitch: float,
    wide_pitch: float,
) -> float:
    """Sum of the brightness of ``count`` hits of one pixel on the ground (n, 6: x, y, s, dx, dy, de).

    ``together`` looks the texture up once for all of them, at their middle and with the pixel's own pitch.
    """
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
        total += ground_light(
            grid, broad, detail, ix, iy, x, y, hits[k, 2], hits[k, 3], hits[k, 4], hits[k, 5], pitch
        )
    return total * share


@part
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


@part
def shows_board(rocks: Rocks, boards: Boards, k: int, t: int, board: int) -> bool:
    """Whether triangle t of a board's mesh is of the face with the picture."""
    normals, faces = rocks.normals, boards.faces_m
    across = 0.0
    for i in range(3):
        across += normals[k, t, 0, i] * faces[board, 3, i]
    return bool(across > 0.9)


@part
def board_light(
    boards: Boards,
    board: int,
    sun: Float64,
    x: float,
    y: float,
    z: float,
    s: float,
    dx: float,
    dy: float,
    dz: float,
    pitch: float,
) -> float:
    """Brightness of a point of a board's face: its picture in the light of sun and sky, without gloss."""
    faces = boards.faces_m
    lx, ly, lz = x - faces[board, 0, 0], y - faces[board, 0, 1], z - faces[board, 0, 2]
    u = lx * faces[board, 1, 0] + ly * faces[board, 1, 1] + lz * faces[board, 1, 2]
    v = lx * faces[board, 2, 0] + ly * faces[board, 2, 1] + lz * faces[board, 2, 2]
    du = dx * faces[board, 1, 0] + dy * faces[board, 1, 1] + dz * faces[board, 1, 2]
    dv = dx * faces[board, 2, 0] + dy * faces[board, 2, 1] + dz * faces[board, 2, 2]
    nx, ny, nz = faces[board, 3, 0], faces[board, 3, 1], faces[board, 3, 2]
    facing = max(-(nx * dx + ny * dy + nz * dz), 0.03)
    level = 1.0 / math.sqrt(du * du + dv * dv + 1e-12)
    p = boards.picture[board]
    picture = Texture(boards.texels, boards.start[p], boards.size[p], boards.levels[p], boards.texel_m[p])
    short = s * pitch
    tone = stretched_brightness(picture, u, v, short, short / facing, du * level, dv * level)
    light = max(nx * sun[0] + ny * sun[1] + nz * sun[2], 0.0)
    above = 0.5 - 0.5 * nz
    tone *= (AMBIENT * (0.45 + 0.55 * above) + (1.0 - AMBIENT) * light) * 1.45
    haze = s / (s + HAZE_M)
    return float(ROCK_TONE * tone * (1.0 - haze) + SKY_HORIZON * haze)


@inlined
def sky_light(de: float) -> float:
    """Brightness of the sky in a direction with upward part ``de``."""
    up = max(de, 0.0)
    return SKY_ZENITH + (SKY_HORIZON - SKY_ZENITH) * math.exp(-3.0 * up)
