"""The simulated world: rays against closed forms and every triangle, what lies where, what is refused."""

from __future__ import annotations

import importlib
import sys
from typing import Any

import numpy as np
import pytest

from drivers.errors import BadOptions
from drivers.sim import rocks
from drivers.sim.placed import SceneSettings
from drivers.sim.scene import Scene
from hil_tests.drivers.sim.small_scenes import build_small_scene

SAME_M = 1e-9
"""float64 along rays of some ten metres leaves 1e-13 m; grazing rays multiply it."""
EYE_M = np.array([0.4, -0.1, -1.5])


@pytest.fixture(scope="module")
def flat() -> Scene:
    return build_small_scene(SceneSettings(seed=3, relief_m=0.0, rocks=0))


@pytest.fixture(scope="module")
def rough() -> Scene:
    return build_small_scene(SceneSettings(seed=3))


def unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def first_triangle_m(origin: np.ndarray, direction: np.ndarray, triangles: np.ndarray) -> float:
    """Distance to the nearest of triangles (n, 3, 3): o + s d = a + u (b - a) + v (c - a), Cramer's rule."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    rest = origin - a
    volume = np.einsum("ij,ij->i", np.cross(b - a, c - a), np.broadcast_to(-direction, a.shape))
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.einsum("ij,ij->i", np.cross(b - a, c - a), rest) / volume
        u = np.einsum("ij,ij->i", np.cross(rest, c - a), np.broadcast_to(-direction, a.shape)) / volume
        v = np.einsum("ij,ij->i", np.cross(b - a, rest), np.broadcast_to(-direction, a.shape)) / volume
    met = (u >= -1e-12) & (v >= -1e-12) & (u + v <= 1 + 1e-12) & (s > 0)
    return float(s[met].min()) if met.any() else np.inf


def cell_triangles(grid: Any, cells: np.ndarray) -> np.ndarray:
    """Both triangles (n, 2, 3, 3) of cells (n, 2: ix, iy), site frame, cut from corner (0, 0) to (1, 1)."""
    corner = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    index = cells[:, None] + corner
    points = np.empty((len(cells), 4, 3))
    points[..., 0] = grid.x0_m + index[..., 0] * grid.cell_m
    points[..., 1] = grid.y0_m + index[..., 1] * grid.cell_m
    points[..., 2] = -grid.elevation_m[index[..., 1], index[..., 0]].astype(np.float64)
    return np.stack([points[:, [0, 1, 2]], points[:, [0, 2, 3]]], axis=1)


def cells_under(grid: Any, origin: np.ndarray, direction: np.ndarray, reach_m: float) -> np.ndarray:
    """Cells (n, 2) that a ray passes over within reach, and their neighbours: by small steps, no walk."""
    s = np.arange(0.0, reach_m, 0.4 * grid.cell_m)
    way = origin[:2] + s[:, None] * direction[:2]
    cells = np.floor((way - [grid.x0_m, grid.y0_m]) / grid.cell_m).astype(np.int64)
    around = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)
    cells = np.unique((cells[:, None] + around).reshape(-1, 2), axis=0)
    return cells[((cells >= 0) & (cells < grid.cells)).all(axis=-1)]


def test_ground_is_met_where_the_nearest_triangle_is(rough: Scene) -> None:
    grid = rough.world.inner
    rng = np.random.default_rng(2)
    azimuth, down = rng.uniform(-np.pi, np.pi, 150), rng.uniform(0.06, 1.2, 150)
    directions = unit(np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(down)], axis=-1))
    no_rocks = Scene(rough.settings, rough.world._replace(rocks=rocks.make_rocks(0, rng, rough.ground_z_m)))
    ranges_m = no_rocks.cast(EYE_M, directions)
    for direction, range_m in zip(directions, ranges_m, strict=True):
        triangles = cell_triangles(grid, cells_under(grid, EYE_M, direction, 31.0))
        expected_m = first_triangle_m(EYE_M, direction, triangles.reshape(-1, 3, 3))
        assert range_m == pytest.approx(expected_m, abs=SAME_M)


def test_rocks_are_met_where_their_nearest_triangle_is(rough: Scene) -> None:
    world = rough.world
    rng = np.random.default_rng(4)
    which = rng.integers(0, len(world.rocks.spheres_m), 120)
    aims = world.rocks.spheres_m[which, :3] + rng.normal(size=(120, 3)) * world.rocks.spheres_m[which, 3:] / 3
    directions = unit(aims - EYE_M)
    on_rock = 0
    for direction, range_m in zip(directions, rough.cast(EYE_M, directions), strict=True):
        ground = cell_triangles(world.inner, cells_under(world.inner, EYE_M, direction, 31.0))
        rock_m = first_triangle_m(EYE_M, direction, world.rocks.corners_m.reshape(-1, 3, 3))
        ground_m = first_triangle_m(EYE_M, direction, ground.reshape(-1, 3, 3))
        nearest_m = min(rock_m, ground_m)
        if np.isfinite(nearest_m):
            assert range_m == pytest.approx(nearest_m, abs=SAME_M)
        else:  # over the inner grid's edge
            assert not range_m < 31.0
        on_rock += rock_m < ground_m
    assert on_rock > 60


def test_no_ray_slips_between_triangles(rough: Scene) -> None:
    """Rays aimed at corners and edges of the ground's cells, straight down and from the side."""
    grid = rough.world.inner
    rng = np.random.default_rng(6)
    cells = rng.integers(900, 1150, (4000, 2))
    along = rng.choice([0.0, 0.5, 1.0], (4000, 1))
    places = (cells + along * rng.choice([0, 1], (4000, 2))) * grid.cell_m + [grid.x0_m, grid.y0_m]
    points = np.column_stack([places, [rough.ground_z_m(x, y) for x, y in places]])
    assert np.isfinite(rough.cast(points - [0.0, 0.0, 1.0], [0.0, 0.0, 1.0])).all()
    points[:, 2] += 1e-6  # under the surface: a ray at a ridge itself may pass over it by rounding
    slanted = points - EYE_M
    assert (rough.cast(EYE_M, slanted) <= np.linalg.norm(slanted, axis=-1) + SAME_M).all()


def test_no_range_without_a_meaning(rough: Scene) -> None:
    down = [0.0, 0.0, 1.0]
    assert np.isnan(rough.cast([3.0, 3.0, 1.0], down)), "starts under the ground"
    assert np.isnan(rough.cast([40.0, 0.0, -1.0], down)), "starts outside the inner grid"
    assert np.isnan(rough.cast(EYE_M, [0.0, 0.0, 0.0]))
    assert np.isnan(rough.cast(EYE_M, [np.nan, 0.0, 1.0]))
    assert np.isnan(rough.cast([0.0, np.inf, -1.0], down))
    assert rough.cast(np.zeros((4, 1, 3)) - [0, 0, 2.0], np.ones((5, 3))).shape == (4, 5)


def test_same_seed_same_scene(rough: Scene, flat: Scene) -> None:
    again = build_small_scene(SceneSettings(seed=3))
    other = build_small_scene(SceneSettings(seed=4))
    for part, name in (
        ("inner", "elevation_m"),
        ("rocks", "corners_m"),
        ("detail", "texels"),
        ("broad", "texels"),
    ):
        mine = getattr(getattr(rough.world, part), name)
        assert np.array_equal(mine, getattr(getattr(again.world, part), name)), part
        assert not np.array_equal(mine, getattr(getattr(other.world, part), name)), part
    assert np.array_equal(rough.world.detail.texels, flat.world.detail.texels), "flat ground keeps its gravel"
    assert not flat.world.inner.elevation_m.any()


def test_without_numba_one_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "numba", None)
    monkeypatch.delitem(sys.modules, "drivers.sim.kernels")
    with pytest.raises(BadOptions, match=r"needs numba: pip install 'mastctl\[sim\]'"):
        importlib.import_module("drivers.sim.kernels")
