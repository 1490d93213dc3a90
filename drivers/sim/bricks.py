"""Bricks: boxes of exactly known corners, standing level on the ground and a little sunk into it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.sim.compiled import kernels
from drivers.sim.rocks import boxes, divided, spheres

Float64 = NDArray[np.float64]

SIZE_M = (0.39, 0.19, 0.19)  # a common building block
SUNK_M = 0.02
RINGS_M = ((1.55, 2.0, 0.75), (5.8, 6.4, 0.9))  # nearest, farthest, azimuth to either side; bricks take turns
APART_M = 0.05
TONE = 1.15
# Corners 0 to 3 go round the top, 4 to 7 lie under them; each face in the sense of outward normals.
_SIDES = ((0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0))
_TOP, _BOTTOM = (0, 1, 2, 3), (4, 7, 6, 5)


@dataclass(frozen=True, eq=False)
class Brick:
    """One brick.

    Attributes
    ----------
    corners_m
        (8, 3) site frame: the four at the top, then those under them.
    """

    corners_m: Float64

    @property
    def faces_m(self) -> Float64:
        """(5, 3) the middles of the top and of the four sides."""
        return np.array([self.corners_m[list(face)].mean(axis=0) for face in (_TOP, *_SIDES)])


def make_brick(
    x_m: float,
    y_m: float,
    turn_rad: float,
    ground_z_m: Callable[[float, float], float],
    size_m: tuple[float, float, float] = SIZE_M,
) -> Brick:
    """Return a brick (length, width, height) about (x, y), its length turned from north to east."""
    length, width, height = size_m
    flat = 0.5 * np.array([[length, width], [length, -width], [-length, -width], [-length, width]])
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    around = flat @ np.array([[cos, sin], [-sin, cos]]) + [x_m, y_m]
    bottom = max(float(ground_z_m(x, y)) for x, y in around) + SUNK_M
    top = np.column_stack([around, np.full(4, bottom - height)])
    return Brick(np.concatenate([top, top + np.array([0.0, 0.0, height])]))


def scattered(
    count: int, rng: np.random.Generator, taken_m: Float64, ground_z_m: Callable[[float, float], float]
) -> tuple[Brick, ...]:
    """Return up to ``count`` bricks, by turns near and far, apart from each other.

    ``taken_m`` (n, 4) are balls (centre, radius) that keep their place.
    """
    reach = 0.5 * float(np.hypot(*SIZE_M[:2]))
    taken = [(float(x), float(y), float(r)) for x, y, _, r in taken_m]
    found: list[Brick] = []
    for index in range(count):
        nearest, farthest, azimuth = RINGS_M[index % len(RINGS_M)]
        for _ in range(300):
            distance, bearing = rng.uniform(nearest, farthest), rng.uniform(-azimuth, azimuth)
            x, y = distance * np.cos(bearing), distance * np.sin(bearing)
            if all(np.hypot(x - a, y - b) > reach + r + APART_M for a, b, r in taken):
                found.append(make_brick(x, y, rng.uniform(0.0, np.pi), ground_z_m))
                taken.append((x, y, reach))
                break
    return tuple(found)


def meshes(bricks: Sequence[Brick]) -> Any:
    """Return the ``kernels.Rocks`` of bricks: each a closed mesh of 20 triangles, divided as rocks are."""
    corners = np.array([divided(_triangles(brick), lambda middles: middles) for brick in bricks])
    corners = corners.reshape(len(bricks), -1, 3, 3)
    across = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    normals = np.repeat(across[:, :, None], 3, axis=2).astype(np.float32)
    tones = np.full(len(bricks), TONE, dtype=np.float32)
    return kernels().Rocks(
        spheres(corners), *(boxes(corners, 4**level) for level in (3, 2, 1)), corners, normals, tones,
        np.full(len(bricks), kernels().NOTHING),
    )  # fmt: skip


def _triangles(brick: Brick) -> Float64:
    """The 20 triangles (20, 3, 3): four about the middle of each side, two on the top and the bottom."""
    p = brick.corners_m
    out = []
    for side in _SIDES:
        middle = p[list(side)].mean(axis=0)
        out += [(p[side[k]], p[side[(k + 1) % 4]], middle) for k in range(4)]
    for a, b, c, d in (_TOP, _BOTTOM):
        out += [(p[a], p[b], p[c]), (p[a], p[c], p[d])]
    return np.array(out)
