"""The simulated world: rays against closed forms and every triangle, what lies where, what is refused."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

from drivers.errors import BadOptions
from drivers.sim import kept, rocks
from drivers.sim.scene import Scene, SceneSettings, build_scene, inner_relief_m, make_grid
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


def test_flat_ground_is_met_where_the_plane_is(flat: Scene) -> None:
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(2000, 3)) * [1.0, 1.0, 0.3]
    ranges_m = flat.cast(EYE_M, directions)
    down = unit(directions)[:, 2]
    with np.errstate(divide="ignore"):
        plane_m = np.where(down > 0, 1.5 / down, np.nan)
    reached = down > 1.5 / 900.0  # the outer grid ends a kilometre away
    np.testing.assert_allclose(ranges_m[reached], plane_m[reached], rtol=1e-9)
    assert np.isnan(ranges_m[down <= 0]).all()
    assert reached.sum() > 900


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


def test_hills_are_met_where_their_nearest_triangle_is(rough: Scene) -> None:
    grid = rough.world.outer
    rng = np.random.default_rng(5)
    azimuth = rng.uniform(-np.pi, np.pi, 60)
    directions = unit(np.stack([np.cos(azimuth), np.sin(azimuth), rng.uniform(-0.03, 0.04, 60)], axis=-1))
    eye_m = np.array([0.0, 0.0, -1.7])
    seen = 0
    for direction, range_m in zip(directions, rough.cast(eye_m, directions), strict=True):
        if range_m < 46.0:
            continue
        triangles = cell_triangles(grid, cells_under(grid, eye_m, direction, 1500.0))
        expected_m = first_triangle_m(eye_m, direction, triangles.reshape(-1, 3, 3))
        if np.isfinite(expected_m):
            assert range_m == pytest.approx(expected_m, abs=1e-6)
            seen += 1
        else:
            assert np.isnan(range_m)
    assert seen > 20


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


def test_ground_height_is_what_a_plumb_line_finds(rough: Scene) -> None:
    rng = np.random.default_rng(7)
    places = rng.uniform(-30, 0, (300, 2))  # behind the rover lie no rocks
    found = rough.cast(np.column_stack([places, np.full(300, -5.0)]), [0.0, 0.0, 1.0]) - 5.0
    np.testing.assert_allclose(found, [rough.ground_z_m(x, y) for x, y in places], atol=SAME_M)


def test_no_range_without_a_meaning(rough: Scene) -> None:
    down = [0.0, 0.0, 1.0]
    assert np.isnan(rough.cast([3.0, 3.0, 1.0], down)), "starts under the ground"
    assert np.isnan(rough.cast([40.0, 0.0, -1.0], down)), "starts outside the inner grid"
    assert np.isnan(rough.cast(EYE_M, [0.0, 0.0, 0.0]))
    assert np.isnan(rough.cast(EYE_M, [np.nan, 0.0, 1.0]))
    assert np.isnan(rough.cast([0.0, np.inf, -1.0], down))
    assert rough.cast(np.zeros((4, 1, 3)) - [0, 0, 2.0], np.ones((5, 3))).shape == (4, 5)


def test_relief_stays_within_its_height_and_is_level_round_the_rover() -> None:
    for relief_m in (0.15, 0.4):
        settings = SceneSettings(relief_m=relief_m)
        elevation_m = inner_relief_m(settings, np.random.default_rng(1))
        n = elevation_m.shape[0] // 2
        assert np.abs(elevation_m).max() <= 1.3 * relief_m
        assert elevation_m.std() > 0.15 * relief_m
        assert elevation_m[n, n] == 0.0
        assert np.abs(elevation_m[n - 16 : n + 17, n - 16 : n + 17]).max() < 0.1 * relief_m
        assert not elevation_m[[0, -1]].any() and not elevation_m[:, [0, -1]].any()
        grid = make_grid(elevation_m, 0.03125)
        assert grid.peaks_m[-1] == elevation_m.max() == np.float32(grid.highest_m)


def test_rocks_are_closed_stones_that_stand_where_they_should(rough: Scene) -> None:
    corners_m = rough.world.rocks.corners_m
    assert corners_m.shape == (50, 1280, 3, 3)
    for rock in corners_m:
        keys = np.unique(np.rint(rock.reshape(-1, 3) * 1e7), axis=0, return_inverse=True)[1].reshape(-1, 3)
        edges = np.concatenate([keys[:, [0, 1]], keys[:, [1, 2]], keys[:, [2, 0]]])
        forward = {(int(a), int(b)) for a, b in edges}
        assert len(forward) == len(edges) and all((b, a) in forward for a, b in forward), (
            "closed, one way out"
        )
        wide_m = np.ptp(rock[..., :2].reshape(-1, 2), axis=0).max()
        assert 0.03 < wide_m < 0.75
        x, y = rock[..., 0].mean(), rock[..., 1].mean()
        assert 1.5 - 0.1 < np.hypot(x, y) < 20.1 and abs(np.arctan2(y, x)) < 1.55
        ground_z_m = rough.ground_z_m(x, y)
        assert rock[..., 2].min() < ground_z_m < rock[..., 2].max(), "partly sunk"


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


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"relief_m": -0.1}, "relief_m -0.1 is not between 0 and 1"),
        ({"rocks": 501}, "rocks 501 is not between 0 and 500"),
        ({"seed": -1}, "seed -1"),
        ({"sun_elevation_rad": float("nan")}, "sun_elevation_rad nan"),
        ({"sun_azimuth_rad": float("inf")}, "sun_azimuth_rad inf"),
    ],
)
def test_settings_out_of_bounds_are_refused(wrong: dict[str, Any], says: str) -> None:
    with pytest.raises(BadOptions, match=says):
        SceneSettings(**wrong)


def test_without_numba_one_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "numba", None)
    for name in [name for name in sys.modules if name.startswith("drivers.sim.kernels")]:
        monkeypatch.delitem(sys.modules, name)
    for call in (build_scene, kept.is_compiled):
        with pytest.raises(BadOptions, match=r"needs numba: pip install 'mastctl\[sim\]'"):
            call()
