"""Rocks and bricks: closed triangle meshes that stand on the ground, a little sunk into it.

Rocks are irregular, nearly convex; bricks are level boxes of exactly known corners.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from drivers.sim import kernels

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
GroundHeight = Callable[[float, float], float]
"""z of the ground at (x, y) of the site frame, metres."""

NEAREST_M = 1.5
FARTHEST_M = 20.0
AZIMUTH_RAD = 1.5
DIAMETERS_M = (0.05, 0.60)
DIVISIONS = 3  # of the icosahedron's 20 faces: 1280 triangles; kernels.Rocks counts on it
CUTS = 13
FACES = """0 11 5  0 5 1  0 1 7  0 7 10  0 10 11  1 5 9  5 11 4  11 10 2  10 7 6  7 1 8
    3 9 4  3 4 2  3 2 6  3 6 8  3 8 9  4 9 5  2 4 11  6 2 10  8 6 7  9 8 1"""  # corners of the icosahedron

BRICK_SIZE_M = (0.39, 0.19, 0.19)  # a common building block
BRICK_SUNK_M = 0.02
BRICK_RINGS_M = (
    (1.55, 2.0, 0.75),
    (5.8, 6.4, 0.9),
)  # nearest, farthest, azimuth to either side; bricks take turns
BRICKS_APART_M = 0.05
BRICK_TONE = 1.15
# Corners 0 to 3 go round the top, 4 to 7 lie under them; each face in the sense of outward normals.
_SIDES = ((0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0))
_TOP, _BOTTOM = (0, 1, 2, 3), (4, 7, 6, 5)


def divided_icosahedron() -> Float64:
    """Return the corners (1280, 3, 3) of triangles on the unit sphere; four in a row have one parent."""
    g = (1.0 + np.sqrt(5.0)) / 2.0
    edges = np.array([[-1, g, 0], [1, g, 0], [-1, -g, 0], [1, -g, 0]])
    corners = np.concatenate([edges, np.roll(edges, 1, axis=1), np.roll(edges, 2, axis=1)])
    faces = np.array(FACES.split(), dtype=np.int64).reshape(20, 3)
    triangles: Float64 = corners[faces] / np.linalg.norm(corners[0])
    return divided(triangles, unit)


def divided(triangles: Float64, placed: Callable[[Float64], Float64]) -> Float64:
    """Return triangles (n, 3, 3) cut into four three times over; ``placed`` moves each new corner (k, 3)."""
    for _ in range(DIVISIONS):
        a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
        ab, bc, ca = (placed(0.5 * (p + q)) for p, q in ((a, b), (b, c), (c, a)))
        children = np.stack([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]])  # (4, 3, n, 3)
        triangles = children.transpose(2, 0, 1, 3).reshape(-1, 3, 3)
    return triangles


def unit(vectors: Float64) -> Float64:
    """Vectors (..., 3) at length one."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def shape(directions: Float64, rng: np.random.Generator) -> Float64:
    """Return how far (...,) a stone reaches along unit directions (..., 3): a ball cut and worn."""
    normals = unit(rng.normal(size=(CUTS, 3)))
    depths = rng.uniform(0.62, 1.0, CUTS)
    cosines = np.maximum(directions @ normals.T, 1e-3)
    limits = np.concatenate([depths / cosines, np.full((*directions.shape[:-1], 1), 1.05)], axis=-1)
    sharpness = rng.uniform(14.0, 40.0)
    reach = np.power(np.power(limits, -sharpness).sum(axis=-1), -1.0 / sharpness)
    for scale, height in ((2.5, 0.05), (6.0, 0.022), (13.0, 0.010)):
        waves, phases = rng.normal(0.0, scale, (3, 3)), rng.uniform(0.0, 2 * np.pi, 3)
        reach *= 1.0 + height * np.sin(directions @ waves.T + phases).mean(axis=-1)
    return np.asarray(reach)


def corner_normals(corners_m: Float64) -> Float64:
    """Return outward normals (n, 3, 3) at the corners of n triangles: halfway between flat and rounded."""
    a, b, c = corners_m[:, 0], corners_m[:, 1], corners_m[:, 2]
    flat = np.cross(b - a, c - a)
    keys = np.rint(corners_m.reshape(-1, 3) * 1e7).astype(np.int64)
    _, index = np.unique(keys, axis=0, return_inverse=True)
    index = index.ravel()
    rounded = np.zeros((index.max() + 1, 3))
    np.add.at(rounded, index, np.repeat(flat, 3, axis=0))
    return unit(unit(rounded[index]).reshape(-1, 3, 3) + 0.5 * unit(flat)[:, None, :])


def places(count: int, rng: np.random.Generator) -> Float64:
    """Return (count, 3): x, y and diameter in metres of rocks that do not stand in each other."""
    found: list[tuple[float, float, float]] = []
    for _ in range(200 * count):
        if len(found) == count:
            break
        distance = NEAREST_M * (FARTHEST_M / NEAREST_M) ** (rng.random() ** 0.75)
        azimuth = rng.uniform(-AZIMUTH_RAD, AZIMUTH_RAD)
        low, high = DIAMETERS_M
        diameter = low * (high / low) ** (rng.random() ** 1.1)
        diameter = max(low, min(diameter, 0.09 * distance))
        x, y = distance * np.cos(azimuth), distance * np.sin(azimuth)
        if distance - diameter < NEAREST_M:
            continue
        if all(np.hypot(x - a, y - b) > 0.75 * (diameter + d) for a, b, d in found):
            found.append((x, y, diameter))
    return np.array(found, dtype=np.float64).reshape(-1, 3)


def make_rocks(count: int, rng: np.random.Generator, ground_z_m: GroundHeight) -> kernels.Rocks:
    """Return ``count`` stones standing on the ground."""
    return stones_at(places(count, rng), rng, ground_z_m)


def stones_at(
    where: Float64,
    rng: np.random.Generator,
    ground_z_m: GroundHeight,
    headings_rad: Sequence[float] | None = None,
) -> kernels.Rocks:
    """Return rocks at (n, 3) places and diameters; turned by chance if no heading is given."""
    sphere = divided_icosahedron()
    corners = np.empty((len(where), len(sphere), 3, 3))
    normals = np.empty((len(where), len(sphere), 3, 3), dtype=np.float32)
    for k, (x, y, diameter) in enumerate(where):
        stone = sphere * shape(sphere, rng)[..., None]
        stone *= rng.uniform([0.8, 0.65, 0.5], [1.0, 0.95, 0.85])
        turn = rng.uniform(0.0, 2 * np.pi)
        if headings_rad is not None:
            turn = headings_rad[k]
        cos, sin = np.cos(turn), np.sin(turn)
        stone = stone @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        stone *= diameter / (stone[..., :2].max() - stone[..., :2].min())
        low, high = stone[..., 2].max(), stone[..., 2].min()  # z is down
        sunk = rng.uniform(0.28, 0.46) * (low - high)
        corners[k] = stone + np.array([x, y, float(ground_z_m(x, y)) - low + sunk])
        normals[k] = corner_normals(corners[k])
    tones = np.exp(rng.normal(0.0, 0.16, len(where))).astype(np.float32)
    return meshed(corners, normals, tones)


def meshed(corners_m: Float64, normals: Float32, tones: Float32) -> kernels.Rocks:
    """Return rocks of meshes (k, 1280, 3, 3) with what bounds them."""
    balls, bounds = spheres(corners_m), [boxes(corners_m, 4**level) for level in (3, 2, 1)]
    return kernels.Rocks(balls, bounds[0], bounds[1], bounds[2], corners_m, normals, tones)


def together(*some: kernels.Rocks) -> kernels.Rocks:
    """Return the ``kernels.Rocks`` of all."""
    return kernels.Rocks(*(np.concatenate(parts) for parts in zip(*some, strict=True)))


def boxes(corners_m: Float64, run: int) -> Float64:
    """Return (k, n / run, 6) boxes around runs of triangles of corners_m (k, n, 3, 3)."""
    count, triangles = corners_m.shape[:2]
    points = corners_m.reshape(count, triangles // run, run * 3, 3)
    return np.ascontiguousarray(np.concatenate([points.min(axis=2), points.max(axis=2)], axis=-1))


def spheres(corners_m: Float64) -> Float64:
    """Return (k, 4) centre and radius of balls around meshes of corners_m (k, n, 3, 3)."""
    points = corners_m.reshape(corners_m.shape[0], 3 * corners_m.shape[1], 3)
    centre = 0.5 * (points.min(axis=1) + points.max(axis=1))
    radius = np.linalg.norm(points - centre[:, None], axis=-1).max(axis=1)
    return np.column_stack([centre, radius * (1.0 + 1e-9)])


def make_brick(
    x_m: float,
    y_m: float,
    turn_rad: float,
    ground_z_m: GroundHeight,
    size_m: tuple[float, float, float] = BRICK_SIZE_M,
) -> Float64:
    """Return the corners (8, 3) of a brick of length, width and height about (x, y), site frame, metres.

    Its length is turned from north to east. The four corners at the top come first, then those under them.
    """
    length, width, height = size_m
    flat = 0.5 * np.array([[length, width], [length, -width], [-length, -width], [-length, width]])
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    around = flat @ np.array([[cos, sin], [-sin, cos]]) + [x_m, y_m]
    bottom = max(float(ground_z_m(x, y)) for x, y in around) + BRICK_SUNK_M
    top = np.column_stack([around, np.full(4, bottom - height)])
    return np.concatenate([top, top + np.array([0.0, 0.0, height])])


def scattered(
    count: int, rng: np.random.Generator, taken_m: Float64, ground_z_m: GroundHeight
) -> list[Float64]:
    """Return up to ``count`` bricks, by turns near and far, apart from each other.

    ``taken_m`` (n, 4) are balls (centre, radius) that keep their place.
    """
    reach = 0.5 * float(np.hypot(*BRICK_SIZE_M[:2]))
    taken = [(float(x), float(y), float(r)) for x, y, _, r in taken_m]
    found: list[Float64] = []
    for index in range(count):
        nearest, farthest, azimuth = BRICK_RINGS_M[index % len(BRICK_RINGS_M)]
        for _ in range(300):
            distance, bearing = rng.uniform(nearest, farthest), rng.uniform(-azimuth, azimuth)
            x, y = distance * np.cos(bearing), distance * np.sin(bearing)
            if all(np.hypot(x - a, y - b) > reach + r + BRICKS_APART_M for a, b, r in taken):
                found.append(make_brick(x, y, rng.uniform(0.0, np.pi), ground_z_m))
                taken.append((x, y, reach))
                break
    return found


def meshes(bricks: Sequence[Float64]) -> kernels.Rocks:
    """Return the ``kernels.Rocks`` of bricks: each a closed mesh of 20 triangles, divided as rocks are."""
    corners = np.array([divided(_triangles(brick), lambda middles: middles) for brick in bricks])
    corners = corners.reshape(len(bricks), -1, 3, 3)
    across = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    normals = np.repeat(across[:, :, None], 3, axis=2).astype(np.float32)
    tones = np.full(len(bricks), BRICK_TONE, dtype=np.float32)
    return meshed(corners, normals, tones)


def _triangles(brick: Float64) -> Float64:
    """The 20 triangles (20, 3, 3): four about the middle of each side, two on the top and the bottom."""
    p, out = brick, []
    for side in _SIDES:
        middle = p[list(side)].mean(axis=0)
        out += [(p[side[k]], p[side[(k + 1) % 4]], middle) for k in range(4)]
    for a, b, c, d in (_TOP, _BOTTOM):
        out += [(p[a], p[b], p[c]), (p[a], p[c], p[d])]
    return np.array(out)
