"""The world of the simulated rover: gravelly ground with relief, rocks, a sun; made from a seed alone.

Site frame: x north, y east, z down, metres. The rover stands at the origin, where the ground is at z = 0.
An inner grid of 3 cm cells reaches 32 m each way; an outer one of 4 m cells carries low hills to the
horizon and is level where the two meet.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from calib.geometry.rigid import Rigid, rot_x, rot_y, rot_z
from drivers.options import DriverOptions
from drivers.sim import ground, rocks
from drivers.sim.compiled import kernels
from drivers.sim.placed import (
    Placed,
    PlacedBoard,
    PlacedBrick,
    PlacedRock,
    check_apart,
    middle_m,
    named,
    placed_or,
    radius_m,
)

Float64 = NDArray[np.float64]

INNER_CELLS = 2048
INNER_CELL_M = 0.03125
OUTER_CELLS = 512
OUTER_CELL_M = 4.0
LEVEL_WITHIN_M = 0.8  # round the rover the relief is nearly flat...
ROUGH_BEYOND_M = 2.5  # ...and whole from here on
HILLS_FROM_M = 70.0
HILL_M = 9.0
SHADOW_SAMPLES = 4  # across a ground texel


class SceneSettings(DriverOptions):
    """What a scene is made of."""

    seed: Annotated[int, Field(ge=0, le=2**63)] = 1
    """Of everything that is scattered."""
    relief_m: Annotated[float, Field(ge=0.0, le=1.0)] = 0.15
    """How far the ground rises and falls about z = 0, metres; 0 gives flat textured ground."""
    rocks: Annotated[int | tuple[PlacedRock, ...], placed_or("rocks", 500)] = 50
    """How many stones of 0.05-0.6 m lie 1.5-20 m away within 1.5 rad of north; or just these."""
    bricks: Annotated[int | tuple[PlacedBrick, ...], placed_or("bricks", 24)] = 0
    """How many bricks stand ahead, by turns 1.8 m and 6 m away, as far as there is space; or just these."""
    boards: Annotated[tuple[PlacedBoard, ...], placed_or("boards")] = ()
    """Boards that stand there. Where one does, or a brick or rock was placed, no scattered one is."""
    sun_azimuth_rad: Annotated[float, Field(ge=-1e3, le=1e3)] = -1.95
    """Where the sun stands, from north over east."""
    sun_elevation_rad: Annotated[float, Field(ge=0.2, le=1.5)] = 0.70
    """Where the sun stands, above the horizon."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_apart(self.placed)
        return self

    @property
    def placed(self) -> dict[str, Placed]:
        """All that was placed, by where it stands in a configuration."""
        return named(self.rocks, self.bricks, self.boards)


class Scene:
    """Ground, rocks, bricks and light, ready for casting rays; made by ``build_scene``, never changed."""

    def __init__(self, settings: SceneSettings, world: Any) -> None:
        self.settings = settings
        self.world = world

    def cast(self, origins_m: ArrayLike, directions: ArrayLike) -> Float64:
        """Return how far rays go before they meet the ground or a rock.

        The geometry is the one the pictures are made of, in float64. Origins (..., 3) are in the site frame,
        above the ground and within 32 m of the origin in x and in y; directions (..., 3) have any length but
        zero; their shapes broadcast. Ranges (...,) are metres along the ray: not-a-number for the sky, for a
        start under the ground or outside the inner grid, and for rays that are not finite.
        """
        origins, wanted = np.broadcast_arrays(
            np.asarray(origins_m, dtype=np.float64), np.asarray(directions, dtype=np.float64)
        )
        shape = origins.shape[:-1]
        origins = np.ascontiguousarray(origins.reshape(-1, 3))
        wanted = wanted.reshape(-1, 3)
        with np.errstate(invalid="ignore", divide="ignore"):
            unit = np.ascontiguousarray(wanted / np.linalg.norm(wanted, axis=-1, keepdims=True))
        reach = INNER_CELLS * INNER_CELL_M / 2
        fit = np.isfinite(unit).all(axis=-1) & (np.abs(origins[:, :2]) < reach).all(axis=-1)
        fit &= np.isfinite(origins[:, 2])
        ranges_m = np.full(len(origins), np.nan)
        found = np.empty(int(fit.sum()))
        kernels().cast_rays(self.world, origins[fit], unit[fit], found)
        ranges_m[fit] = found
        return ranges_m.reshape(shape)

    def ground_z_m(self, x_m: float, y_m: float) -> float:
        """Return z of the ground (rocks apart) under (x, y), metres in the site frame."""
        return ground_z_m(self.world.inner, x_m, y_m)

    def standing(
        self, x_m: float, y_m: float, heading_rad: float, pitch_rad: float = 0.0, roll_rad: float = 0.0
    ) -> Rigid:
        """Return site_from_rover of a rover whose origin lies on the ground at (x, y), metres.

        It is turned about its x (roll), then y (pitch, nose up), then z (heading, to the right).
        """
        rotation = rot_z(heading_rad) @ rot_y(pitch_rad) @ rot_x(roll_rad)
        return Rigid(rotation, np.array([x_m, y_m, self.ground_z_m(x_m, y_m)]))


def build_scene(settings: SceneSettings | None = None) -> Scene:
    """Return the scene of ``settings``; takes some two seconds once the kernels are compiled.

    Raises BadOptions if numba is not installed.
    """
    settings = settings or SceneSettings()
    # one stream of numbers for each part: a flat scene keeps the stones and gravel of the rough one
    relief_rng, hill_rng, rock_rng, gravel_rng, tone_rng, stone_rng, brick_rng, placed_rng = (
        np.random.default_rng(child) for child in np.random.SeedSequence(settings.seed).spawn(8)
    )
    sun = sun_direction(settings)
    inner = make_grid(inner_relief_m(settings, relief_rng), INNER_CELL_M)
    outer = make_grid(outer_relief_m(settings, hill_rng), OUTER_CELL_M)
    stones, laid = laid_out(settings, rock_rng, brick_rng, placed_rng, partial(ground_z_m, inner))
    if laid:
        stones = rocks.together(stones, rocks.meshes(laid))
    tones = ground_tones(inner, sun, tone_rng) * shadows(inner, stones, sun)
    detail = ground.pyramid(ground.gravel(gravel_rng, sun, ground.DETAIL_TEXELS), ground.DETAIL_TEXEL_M)
    stone = ground.pyramid(ground.stone(stone_rng, ground.STONE_TEXELS), ground.STONE_TEXEL_M)
    broad = ground.pyramid(tones, INNER_CELL_M)
    world = kernels().World(inner, outer, stones, detail, broad, stone, sun)
    return Scene(settings, world)


def laid_out(
    settings: SceneSettings,
    rock_rng: np.random.Generator,
    brick_rng: np.random.Generator,
    placed_rng: np.random.Generator,
    ground_m: Callable[[float, float], float],
) -> tuple[Any, list[Float64]]:
    """Return ``kernels.Rocks`` of the stones, and the bricks; scattered ones keep away from placed things."""
    placed = settings.placed.values()
    taken_m = np.array([[*middle_m(thing), 0.0, radius_m(thing)] for thing in placed]).reshape(-1, 4)
    if isinstance(settings.rocks, tuple):
        where = np.array([[rock.x_m, rock.y_m, rock.diameter_m] for rock in settings.rocks]).reshape(-1, 3)
        stones = rocks.stones_at(where, placed_rng, ground_m, [rock.heading_rad for rock in settings.rocks])
    else:
        stones = rocks.make_rocks(settings.rocks, rock_rng, ground_m)
        apart = stones.spheres_m[:, None] - taken_m[None]
        free = (np.hypot(apart[..., 0], apart[..., 1]) > stones.spheres_m[:, None, 3] + taken_m[:, 3]).all(
            axis=1
        )
        stones = type(stones)(*(np.ascontiguousarray(part[free]) for part in stones))
    if isinstance(settings.bricks, tuple):
        return stones, [
            rocks.make_brick(
                one.x_m, one.y_m, one.heading_rad, ground_m, (one.length_m, one.width_m, one.height_m)
            )
            for one in settings.bricks
        ]
    taken_m = np.concatenate([stones.spheres_m, taken_m])
    return stones, rocks.scattered(settings.bricks, brick_rng, taken_m, ground_m)


def tiny_scene() -> Scene:
    """Return a level scene with one rock and next to no texture, made in no time: for compiling only."""
    settings = SceneSettings(relief_m=0.0, rocks=1)
    rng = np.random.default_rng(settings.seed)
    sun = sun_direction(settings)
    inner = make_grid(np.zeros((9, 9), dtype=np.float32), INNER_CELLS * INNER_CELL_M / 8)
    stones = rocks.make_rocks(1, rng, partial(ground_z_m, inner))
    broad = ground.pyramid(shadows(inner, stones, sun), inner.cell_m)
    detail = ground.pyramid(ground.gravel(rng, sun, 128), ground.DETAIL_TEXEL_M)
    stone = ground.pyramid(ground.stone(rng, 128), ground.STONE_TEXEL_M)
    world = kernels().World(inner, inner, stones, detail, broad, stone, sun)
    return Scene(settings, world)


def sun_direction(settings: SceneSettings) -> Float64:
    """Unit vector (3,) towards the sun, site frame."""
    azimuth, elevation = settings.sun_azimuth_rad, settings.sun_elevation_rad
    level = math.cos(elevation)
    return np.array([level * math.cos(azimuth), level * math.sin(azimuth), -math.sin(elevation)])


def inner_relief_m(settings: SceneSettings, rng: np.random.Generator) -> NDArray[np.float32]:
    """Elevations (n + 1, n + 1) [y, x] of the inner grid, nil on its rim and nearly so round the rover."""
    n = INNER_CELLS
    axis = np.asarray((np.arange(n + 1) - n / 2) * INNER_CELL_M, dtype=np.float64)
    rim = np.maximum(np.abs(axis)[:, None], np.abs(axis)[None, :])
    level_at_rim = 1.0 - smooth_step(rim, 28.0, 31.8)
    swells = ground.fractal(n, rng, 1.9, 0.8 / INNER_CELL_M, 12.0 / INNER_CELL_M)
    bumps = ground.fractal(n, rng, 1.7, 2.0, 0.8 / INNER_CELL_M)
    # a peak of three standard deviations comes to relief_m
    relief = settings.relief_m * (0.33 * swells + 0.035 * bumps)
    elevation = np.zeros((n + 1, n + 1), dtype=np.float64)
    elevation[:n, :n] = np.clip(relief, -settings.relief_m, settings.relief_m)
    distance = np.hypot(axis[:, None], axis[None, :])
    near = 0.06 + 0.94 * smooth_step(distance, LEVEL_WITHIN_M, ROUGH_BEYOND_M)
    elevation *= near * level_at_rim
    elevation -= elevation[n // 2, n // 2] * (1.0 - smooth_step(distance, LEVEL_WITHIN_M, ROUGH_BEYOND_M))
    return elevation.astype(np.float32)


def outer_relief_m(settings: SceneSettings, rng: np.random.Generator) -> NDArray[np.float32]:
    """Elevations (n + 1, n + 1) [y, x] of the outer grid: level where the inner one is, then low hills."""
    n = OUTER_CELLS
    elevation = np.zeros((n + 1, n + 1), dtype=np.float64)
    if settings.relief_m == 0:
        return elevation.astype(np.float32)
    hills = ground.fractal(n, rng, 1.6, 4.0, 120.0)
    axis = (np.arange(n + 1) - n / 2) * OUTER_CELL_M
    distance = np.hypot(axis[:, None], axis[None, :])
    elevation[:n, :n] = np.maximum(hills + 0.5, -0.5)
    elevation *= HILL_M * smooth_step(distance, HILLS_FROM_M, 700.0)
    return elevation.astype(np.float32)


def smooth_step(values: Float64, low: float, high: float) -> Float64:
    """0 below ``low``, 1 above ``high``, an S between."""
    t = np.clip((values - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def make_grid(elevation_m: NDArray[np.float32], cell_m: float) -> Any:
    """Return the ``kernels.Grid`` about the origin with the highest corner of every block of cells."""
    n = elevation_m.shape[0] - 1
    corners = (elevation_m[:-1, :-1], elevation_m[:-1, 1:], elevation_m[1:, :-1], elevation_m[1:, 1:])
    peaks = np.maximum.reduce(corners)
    blocks: list[NDArray[np.float32]] = []
    start = [0]
    while peaks.shape[0] > 1:
        m = peaks.shape[0] // 2
        start.append(sum(block.size for block in blocks))
        peaks = peaks.reshape(m, 2, m, 2).max(axis=(1, 3))
        blocks.append(peaks.ravel())
    half = n * cell_m / 2
    return kernels().Grid(
        np.ascontiguousarray(elevation_m),
        np.concatenate(blocks),
        np.array(start, dtype=np.int64),
        n,
        len(blocks),
        cell_m,
        -half,
        -half,
        float(elevation_m.min()),
        float(elevation_m.max()),
    )


def ground_z_m(grid: Any, x_m: float, y_m: float) -> float:
    """z of the triangle of ``grid`` under (x, y)."""
    px, py = (x_m - grid.x0_m) / grid.cell_m, (y_m - grid.y0_m) / grid.cell_m
    ix, iy = int(np.clip(px, 0, grid.cells - 1)), int(np.clip(py, 0, grid.cells - 1))
    u, v = px - ix, py - iy
    (h00, h10), (h01, h11) = np.asarray(grid.elevation_m[iy : iy + 2, ix : ix + 2], dtype=np.float64)
    rise = u * (h10 - h00) + v * (h11 - h10) if u >= v else v * (h01 - h00) + u * (h11 - h01)
    return float(-(h00 + rise))


def ground_tones(grid: Any, sun: Float64, rng: np.random.Generator) -> NDArray[np.float32]:
    """Relative brightness (n, n) [y, x] of the inner grid's cells: light and dark soil, lit by the sun."""
    module = kernels()
    e = grid.elevation_m.astype(np.float64)
    sx = (e[:-1, 1:] - e[:-1, :-1] + e[1:, 1:] - e[1:, :-1]) / (2 * grid.cell_m)
    sy = (e[1:, :-1] - e[:-1, :-1] + e[1:, 1:] - e[:-1, 1:]) / (2 * grid.cell_m)
    cosine = np.maximum(-sx * sun[0] - sy * sun[1] - sun[2], 0.0) / np.sqrt(1.0 + sx * sx + sy * sy)
    light = module.AMBIENT + (1.0 - module.AMBIENT) * cosine
    level = module.AMBIENT - (1.0 - module.AMBIENT) * sun[2]
    soil = ground.fractal(grid.cells, rng, 0.75, 2.0, 10.0 / grid.cell_m)
    soil = np.exp(0.13 * soil)
    return np.asarray(soil * light / level, dtype=np.float32)


def shadows(grid: Any, stones: Any, sun: Float64) -> NDArray[np.float32]:
    """What part (n, n) [y, x] of its light each ground texel keeps beside the rocks."""
    module = kernels()
    kept = np.ones((grid.cells, grid.cells), dtype=np.float32)
    in_shade = module.AMBIENT / (module.AMBIENT - (1.0 - module.AMBIENT) * sun[2])
    fine = (np.arange(SHADOW_SAMPLES) + 0.5) / SHADOW_SAMPLES
    for x, y, z, radius in stones.spheres_m:
        throw = (radius + max(-z + radius, 0.0)) / math.tan(math.asin(-sun[2]))
        ends = np.array([[x, y], [x, y] - throw * sun[:2] / np.hypot(sun[0], sun[1])])
        low = np.floor((ends.min(axis=0) - 1.2 * radius - grid.x0_m) / grid.cell_m).astype(int)
        high = np.ceil((ends.max(axis=0) + 1.2 * radius - grid.x0_m) / grid.cell_m).astype(int)
        low, high = np.clip(low, 0, grid.cells), np.clip(high, 0, grid.cells)
        xs = (np.arange(low[0], high[0])[:, None] + fine).ravel() * grid.cell_m + grid.x0_m
        ys = (np.arange(low[1], high[1])[:, None] + fine).ravel() * grid.cell_m + grid.y0_m
        points = np.empty((len(ys), len(xs), 3))
        points[..., 0], points[..., 1] = xs, ys[:, None]
        points[..., 2] = coarse_z_m(grid, low, high)
        clear = np.empty(points[..., 0].size, dtype=np.float32)
        module.shadow_rays(stones, sun, points.reshape(-1, 3), clear)
        q = SHADOW_SAMPLES
        clear = clear.reshape(high[1] - low[1], q, high[0] - low[0], q).mean(axis=(1, 3))
        block = kept[low[1] : high[1], low[0] : high[0]]
        np.minimum(block, in_shade + (1.0 - in_shade) * clear, out=block)
    return kept


def coarse_z_m(grid: Any, low: NDArray[np.int64], high: NDArray[np.int64]) -> Float64:
    """z at the shadow samples of a block of cells [low, high): each cell's mean height, repeated."""
    e = grid.elevation_m[low[1] : high[1] + 1, low[0] : high[0] + 1].astype(np.float64)
    middle = -0.25 * (e[:-1, :-1] + e[:-1, 1:] + e[1:, :-1] + e[1:, 1:])
    return np.repeat(np.repeat(middle, SHADOW_SAMPLES, axis=0), SHADOW_SAMPLES, axis=1)
