"""The world of the simulated rover: gravelly ground with relief, rocks, a sun; made from a seed alone.

Site frame: x north, y east, z down, metres. The rover stands at the origin, where the ground is at z = 0.
An inner grid of 3 cm cells reaches 32 m each way; an outer one of 4 m cells carries low hills to the
horizon and is level where the two meet. Pictures of gravel and stone are halved again and again for distant
views. A scene that was built is kept on disk, read in no time, its pages shared by all processes.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import shutil
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from calib.geometry.rigid import Rigid, rot_x, rot_y, rot_z
from drivers.sim import kernels, rocks
from drivers.sim.kept import digest_of, keep_newest, kept_folder
from drivers.sim.placed import SceneSettings, middle_m, radius_m

Float32 = NDArray[np.float32]
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
MAKERS = ("kernels", "placed", "rocks", "scene")  # the modules that a scene depends on
DETAIL_TEXELS = 4096
DETAIL_TEXEL_M = 0.001
STONE_TEXELS = 1024
STONE_TEXEL_M = 0.001
# half length of the pebbles in texels (millimetres), and the share of the ground that each class covers
PEBBLES = ((1.2, 2.5, 0.22), (2.5, 5.0, 0.16), (5.0, 11.0, 0.10), (11.0, 24.0, 0.05), (24.0, 40.0, 0.012))


class Scene:
    """Ground, rocks, bricks and light, ready for casting rays; made by ``build_scene``, never changed."""

    def __init__(self, settings: SceneSettings, world: kernels.World) -> None:
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
        kernels.cast_rays(self.world, origins[fit], unit[fit], found)
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
    """Return the scene of ``settings``; takes some two seconds once the kernels are compiled."""
    settings = settings or SceneSettings()
    # one stream of numbers for each part: a flat scene keeps the stones and gravel of the rough one
    relief_rng, hill_rng, rock_rng, gravel_rng, tone_rng, stone_rng, brick_rng, placed_rng = (
        np.random.default_rng(child) for child in np.random.SeedSequence(settings.seed).spawn(8)
    )
    sun = sun_direction(settings)
    inner = make_grid(inner_relief_m(settings, relief_rng), INNER_CELL_M)
    outer = make_grid(outer_relief_m(settings, hill_rng), OUTER_CELL_M)
    stones = laid_out(settings, (rock_rng, brick_rng, placed_rng), partial(ground_z_m, inner))
    tones = ground_tones(inner, sun, tone_rng) * shadows(inner, stones, sun)
    detail = pyramid(gravel(gravel_rng, sun, DETAIL_TEXELS), DETAIL_TEXEL_M)
    surface = pyramid(stone(stone_rng, STONE_TEXELS), STONE_TEXEL_M)
    world = kernels.World(inner, outer, stones, detail, pyramid(tones, INNER_CELL_M), surface, sun)
    return Scene(settings, world)


def laid_out(
    settings: SceneSettings, chance: Sequence[np.random.Generator], ground_m: rocks.GroundHeight
) -> kernels.Rocks:
    """Return stones and bricks; scattered ones keep away from placed things.

    ``chance`` scatters rocks, scatters bricks, and shapes placed rocks.
    """
    rock_rng, brick_rng, placed_rng = chance
    placed = settings.placed.values()
    taken_m = np.array([[*middle_m(thing), 0.0, radius_m(thing)] for thing in placed]).reshape(-1, 4)
    if isinstance(settings.rocks, tuple):
        where = np.array([[rock.x_m, rock.y_m, rock.diameter_m] for rock in settings.rocks]).reshape(-1, 3)
        stones = rocks.stones_at(where, placed_rng, ground_m, [rock.heading_rad for rock in settings.rocks])
    else:
        stones = rocks.make_rocks(settings.rocks, rock_rng, ground_m)
        apart_m = np.hypot(*(stones.spheres_m[:, None] - taken_m[None])[..., :2].transpose(2, 0, 1))
        free = (apart_m > stones.spheres_m[:, None, 3] + taken_m[:, 3]).all(axis=1)
        stones = kernels.Rocks(*(np.ascontiguousarray(part[free]) for part in stones))
    if isinstance(settings.bricks, tuple):
        bricks = [
            rocks.make_brick(b.x_m, b.y_m, b.heading_rad, ground_m, (b.length_m, b.width_m, b.height_m))
            for b in settings.bricks
        ]
    else:
        taken_m = np.concatenate([stones.spheres_m, taken_m])
        bricks = rocks.scattered(settings.bricks, brick_rng, taken_m, ground_m)
    return rocks.together(stones, rocks.meshes(bricks)) if bricks else stones


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
    swells = fractal(n, rng, 1.9, 0.8 / INNER_CELL_M, 12.0 / INNER_CELL_M)
    bumps = fractal(n, rng, 1.7, 2.0, 0.8 / INNER_CELL_M)
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
    hills = fractal(n, rng, 1.6, 4.0, 120.0)
    axis = (np.arange(n + 1) - n / 2) * OUTER_CELL_M
    distance = np.hypot(axis[:, None], axis[None, :])
    elevation[:n, :n] = np.maximum(hills + 0.5, -0.5)
    elevation *= HILL_M * smooth_step(distance, HILLS_FROM_M, 700.0)
    return elevation.astype(np.float32)


def smooth_step(values: Float64, low: float, high: float) -> Float64:
    """0 below ``low``, 1 above ``high``, an S between."""
    t = np.clip((values - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def make_grid(elevation_m: NDArray[np.float32], cell_m: float) -> kernels.Grid:
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
    return kernels.Grid(
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


def ground_z_m(grid: kernels.Grid, x_m: float, y_m: float) -> float:
    """z of the triangle of ``grid`` under (x, y)."""
    px, py = (x_m - grid.x0_m) / grid.cell_m, (y_m - grid.y0_m) / grid.cell_m
    ix, iy = int(np.clip(px, 0, grid.cells - 1)), int(np.clip(py, 0, grid.cells - 1))
    u, v = px - ix, py - iy
    (h00, h10), (h01, h11) = np.asarray(grid.elevation_m[iy : iy + 2, ix : ix + 2], dtype=np.float64)
    rise = u * (h10 - h00) + v * (h11 - h10) if u >= v else v * (h01 - h00) + u * (h11 - h01)
    return float(-(h00 + rise))


def ground_tones(grid: kernels.Grid, sun: Float64, rng: np.random.Generator) -> NDArray[np.float32]:
    """Relative brightness (n, n) [y, x] of the inner grid's cells: light and dark soil, lit by the sun."""
    e = grid.elevation_m.astype(np.float64)
    sx = (e[:-1, 1:] - e[:-1, :-1] + e[1:, 1:] - e[1:, :-1]) / (2 * grid.cell_m)
    sy = (e[1:, :-1] - e[:-1, :-1] + e[1:, 1:] - e[:-1, 1:]) / (2 * grid.cell_m)
    cosine = np.maximum(-sx * sun[0] - sy * sun[1] - sun[2], 0.0) / np.sqrt(1.0 + sx * sx + sy * sy)
    light = kernels.AMBIENT + (1.0 - kernels.AMBIENT) * cosine
    level = kernels.AMBIENT - (1.0 - kernels.AMBIENT) * sun[2]
    soil = fractal(grid.cells, rng, 0.75, 2.0, 10.0 / grid.cell_m)
    soil = np.exp(0.13 * soil)
    return np.asarray(soil * light / level, dtype=np.float32)


def shadows(grid: kernels.Grid, stones: kernels.Rocks, sun: Float64) -> NDArray[np.float32]:
    """What part (n, n) [y, x] of its light each ground texel keeps beside the rocks."""
    kept = np.ones((grid.cells, grid.cells), dtype=np.float32)
    in_shade = kernels.AMBIENT / (kernels.AMBIENT - (1.0 - kernels.AMBIENT) * sun[2])
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
        e = grid.elevation_m[low[1] : high[1] + 1, low[0] : high[0] + 1].astype(np.float64)
        middle_z_m = -0.25 * (e[:-1, :-1] + e[:-1, 1:] + e[1:, :-1] + e[1:, 1:])  # of each cell
        points[..., 2] = np.repeat(np.repeat(middle_z_m, SHADOW_SAMPLES, axis=0), SHADOW_SAMPLES, axis=1)
        clear = np.empty(points[..., 0].size, dtype=np.float32)
        kernels.shadow_rays(stones, sun, points.reshape(-1, 3), clear)
        q = SHADOW_SAMPLES
        clear = clear.reshape(high[1] - low[1], q, high[0] - low[0], q).mean(axis=(1, 3))
        block = kept[low[1] : high[1], low[0] : high[0]]
        np.minimum(block, in_shade + (1.0 - in_shade) * clear, out=block)
    return kept


def fractal(
    size: int, rng: np.random.Generator, falloff: float, shortest_px: float, longest_px: float
) -> Float32:
    """Return repeating noise (size, size) of mean 0 and variance 1.

    Amplitude falls as frequency ** -falloff between the two wavelengths and is nil outside them.
    """
    from scipy import fft  # loaded in 0.2 s, and only where a scene is made anew

    spectrum = fft.rfft2(rng.standard_normal((size, size), dtype=np.float32))
    fy = fft.fftfreq(size).astype(np.float32)[:, None]
    fx = fft.rfftfreq(size).astype(np.float32)[None, :]
    frequency = np.hypot(fx, fy)
    inside = (frequency >= 1.0 / longest_px) & (frequency <= 1.0 / shortest_px)
    frequency[~inside] = 1.0
    spectrum *= np.where(inside, frequency ** np.float32(-falloff), np.float32(0.0))
    noise = fft.irfft2(spectrum, s=(size, size))
    return np.asarray(noise / noise.std(), dtype=np.float32)


def gravel(rng: np.random.Generator, sun: NDArray[np.float64], size: int) -> Float32:
    """Return a repeating picture of sand with pebbles, mean 1, lit from ``sun`` (unit, site frame)."""
    tones = 1.0 + 0.11 * fractal(size, rng, 0.9, 2.5, 400.0)
    rough = np.clip(fractal(size, rng, 1.2, 3.0, 40.0), -2.0, 2.0)
    layers = []
    for low, high, share in PEBBLES:
        count = int(share * size * size / (np.pi * 0.75 * (0.5 * (low + high)) ** 2))
        half_length = low * (high / low) ** rng.random(count)
        pebble = np.empty((count, 6))
        pebble[:, 0:2] = rng.random((count, 2)) * size
        pebble[:, 2] = half_length
        pebble[:, 3] = half_length * rng.uniform(0.55, 0.95, count)
        pebble[:, 4] = rng.uniform(0.0, np.pi, count)
        pebble[:, 5] = np.exp(rng.normal(0.0, 0.19, count))
        layers.append(pebble)
    kernels.lay_pebbles(tones, rough, np.concatenate(layers), sun[0], sun[1], -sun[2])
    tones = np.minimum(tones, 1.9)
    return np.asarray(tones / tones.mean(), dtype=np.float32)


def stone(rng: np.random.Generator, size: int) -> Float32:
    """Return a repeating picture of a rock's surface, mean 1: blotches, grain and pits."""
    tones = 1.0 + 0.13 * fractal(size, rng, 1.2, 3.0, 500.0) + 0.09 * fractal(size, rng, 0.3, 2.5, 16.0)
    pits = fractal(size, rng, 0.8, 6.0, 60.0)
    tones *= 1.0 - 0.40 * np.clip(pits - 1.2, 0.0, 1.0)
    return np.asarray(tones / tones.mean(), dtype=np.float32)


def pyramid(tones: Float32, texel_m: float) -> kernels.Texture:
    """Return the ``kernels.Texture`` of a square picture of relative brightness, side a power of two.

    Each level is the 2 x 2 means of the one before, down to 4 texels across, so that edges stay aligned.
    """
    levels = [np.asarray(tones, dtype=np.float32)]
    while levels[-1].shape[0] > 4:
        n = levels[-1].shape[0] // 2
        levels.append(levels[-1].reshape(n, 2, n, 2).mean(axis=(1, 3), dtype=np.float32))
    padded = [np.pad(level, [(0, 1), (0, kernels.PAD)], mode="wrap") for level in levels]
    texels = np.concatenate([level.ravel() for level in padded])
    start = np.cumsum([0, *(level.size for level in padded[:-1])]).astype(np.int64)
    stored = np.clip(np.rint(texels * kernels.ONE), 0, 65535).astype(np.uint16)
    return kernels.Texture(stored, start, tones.shape[0], len(levels), texel_m)


def kept_scene(settings: SceneSettings) -> Scene:
    """Return what `build_scene` returns, from disk if it was built before by the same sources.

    A scene that cannot be read, or is damaged, is built and written again; where nothing can be written, it
    is built each time.
    """
    folder = folder_of(settings)
    with contextlib.suppress(OSError, ValueError, TypeError):  # not there, or not whole
        world = _read(folder, "world", kernels.World)
        with contextlib.suppress(OSError):
            os.utime(folder)  # used last
        return Scene(settings, world)
    found = build_scene(settings)
    with contextlib.suppress(OSError):
        _write(folder, found)
        keep_newest(folder)
    return found


def folder_of(settings: SceneSettings) -> Path:
    """Return where a scene is kept: under the digest of its settings and of all that makes it."""
    makers = digest_of(Path(__file__).with_name(f"{name}.py") for name in MAKERS)
    facts = (repr(settings), makers, np.__version__, scipy.__version__)
    return kept_folder("scenes", hashlib.sha256("\n".join(facts).encode()).hexdigest())


def parts(value: Any, name: str) -> list[tuple[str, Any]]:
    """Return names and values of all arrays and numbers in tuples in tuples."""
    if not hasattr(value, "_fields"):
        return [(name, value)]
    return [part for field in value._fields for part in parts(getattr(value, field), f"{name}.{field}")]


def _write(folder: Path, made: Scene) -> None:
    """Write a scene, whole or not at all: each array and number to a file of its own."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(dir=folder.parent))
    try:
        for name, value in parts(made.world, "world"):
            np.save(scratch / f"{name}.npy", value)
        shutil.rmtree(folder, ignore_errors=True)  # what is there was not good
        scratch.replace(folder)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _read(folder: Path, name: str, kind: Any) -> Any:
    """A part of a scene that was written: arrays in private pages, copied where a process writes into one."""
    if hasattr(kind, "_fields"):
        return kind(*(_read(folder, f"{name}.{key}", of) for key, of in get_type_hints(kind).items()))
    file = folder / f"{name}.npy"
    return np.load(file).item() if kind in (int, float) else np.asarray(np.load(file, mmap_mode="c"))
