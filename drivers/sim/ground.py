"""Ground: a height map and a picture of one's own, and pictures of gravel and stone made from a seed.

Maps are laid over the middle of the scene, north up: rows go south, columns east. Heights are metres upwards,
counted from the ground at the site's origin, where the rover stands. Pictures are halved again and again for
distant views.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from drivers.errors import BadOptions
from drivers.options import check_bounds, filled
from drivers.sim.kept import kernels
from drivers.sim.placed import read_picture

Float32 = NDArray[np.float32]

DETAIL_TEXELS = 4096
DETAIL_TEXEL_M = 0.001
STONE_TEXELS = 1024
STONE_TEXEL_M = 0.001
# half length of the pebbles in texels (millimetres), and the share of the ground that each class covers
PEBBLES = ((1.2, 2.5, 0.22), (2.5, 5.0, 0.16), (5.0, 11.0, 0.10), (11.0, 24.0, 0.05), (24.0, 40.0, 0.012))

Float64 = NDArray[np.float64]

KEY = "simulation.scene.terrain"
MOST_SAMPLES = 8192
HIGHEST_M = 30.0
FADE_M = 2.0
"""Beyond the map's edge the ground goes back to the height of the origin within so far."""

BOUNDS = {
    "m_per_px": (0.005, 20.0),
    "origin_x_m": (-1e4, 1e4),
    "origin_y_m": (-1e4, 1e4),
    "black_m": (-1e4, 1e4),
    "white_m": (-1e4, 1e4),
}


def fractal(
    size: int, rng: np.random.Generator, falloff: float, shortest_px: float, longest_px: float
) -> Float32:
    """Return repeating noise (size, size) of mean 0 and variance 1.

    Amplitude falls as frequency ** -falloff between the two wavelengths and is nil outside them.
    """
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
    kernels().lay_pebbles(tones, rough, np.concatenate(layers), sun[0], sun[1], -sun[2])
    tones = np.minimum(tones, 1.9)
    return np.asarray(tones / tones.mean(), dtype=np.float32)


def stone(rng: np.random.Generator, size: int) -> Float32:
    """Return a repeating picture of a rock's surface, mean 1: blotches, grain and pits."""
    tones = 1.0 + 0.13 * fractal(size, rng, 1.2, 3.0, 500.0) + 0.09 * fractal(size, rng, 0.3, 2.5, 16.0)
    pits = fractal(size, rng, 0.8, 6.0, 60.0)
    tones *= 1.0 - 0.40 * np.clip(pits - 1.2, 0.0, 1.0)
    return np.asarray(tones / tones.mean(), dtype=np.float32)


def halved(tones: Float32) -> list[Float32]:
    """Return ``tones`` and its 2 x 2 means, over and over, down to 4 texels across; edges stay aligned."""
    levels = [np.asarray(tones, dtype=np.float32)]
    while levels[-1].shape[0] > 4:
        n = levels[-1].shape[0] // 2
        levels.append(levels[-1].reshape(n, 2, n, 2).mean(axis=(1, 3), dtype=np.float32))
    return levels


def pyramid(tones: Float32, texel_m: float) -> Any:
    """Return the ``kernels.Texture`` of a square picture of relative brightness, side a power of two."""
    module = kernels()
    levels = halved(tones)
    padded = [np.pad(level, [(0, 1), (0, module.PAD)], mode="wrap") for level in levels]
    texels = np.concatenate([level.ravel() for level in padded])
    start = np.cumsum([0, *(level.size for level in padded[:-1])]).astype(np.int64)
    stored = np.clip(np.rint(texels * module.ONE), 0, 65535).astype(np.uint16)
    return module.Texture(stored, start, tones.shape[0], len(levels), texel_m)


@dataclass(frozen=True)
class OwnTerrain:
    """A height map and where it lies.

    Attributes
    ----------
    heights
        A NumPy file (``.npy``) of metres, (rows, columns), or a grey PNG of 8 or 16 bits.
    m_per_px
        Between neighbouring samples, 0.005 to 20.
    origin_x_m, origin_y_m
        Where the first sample of the first row lies, the north-western one; site frame.
    black_m, white_m
        Heights of a PNG's darkest and brightest value.
    texture
        A picture of the ground that the map's samples and half a sample around them cover; or none.
    gravel
        Whether the seed's gravel lies on it.
    """

    heights: str = ""
    m_per_px: float = 0.1
    origin_x_m: float = 0.0
    origin_y_m: float = 0.0
    black_m: float = 0.0
    white_m: float = 1.0
    texture: str = ""
    gravel: bool = True
    digest: str = ""


def read_terrain(section: Any, folder: Path) -> OwnTerrain:
    """Return the settings of ``simulation.scene.terrain``, with a digest of what its files hold.

    Raises
    ------
    BadOptions
        With the key, the value, and what would be right.
    """
    if isinstance(section, Mapping) and "digest" in section:
        raise BadOptions(f"{KEY} has no key 'digest'")
    terrain: OwnTerrain = filled(OwnTerrain(), section, KEY)
    check_bounds(terrain, BOUNDS, KEY)
    if not terrain.heights:
        raise BadOptions(f"{KEY} has no heights; the name of a .npy or PNG file is expected")
    path = (folder / terrain.heights).resolve()
    map_m = heights_m(replace(terrain, heights=str(path)))
    digest = hashlib.sha256(map_m.tobytes()).hexdigest()[:16]
    texture = ""
    if terrain.texture:
        _, of_picture, place = read_picture(terrain.texture, f"{KEY}.texture", folder)
        digest, texture = digest + of_picture, str(place)
    rows, columns = map_m.shape
    far = terrain.m_per_px
    south_m, east_m = terrain.origin_x_m - (rows - 1) * far, terrain.origin_y_m + (columns - 1) * far
    if not (south_m <= 0.0 <= terrain.origin_x_m and terrain.origin_y_m <= 0.0 <= east_m):
        raise BadOptions(
            f"{KEY} covers x {south_m:g} to {terrain.origin_x_m:g} m and y {terrain.origin_y_m:g} to "
            f"{east_m:g} m, expected the site's origin within: there the rover stands"
        )
    return replace(terrain, heights=str(path), texture=texture, digest=digest)


def heights_m(terrain: OwnTerrain) -> Float64:
    """Return the map (rows, columns), metres upwards. Raises BadOptions as `read_terrain`."""
    path, key = Path(terrain.heights), f"{KEY}.heights"
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BadOptions(f"{key}: {path}: {error.strerror}; a .npy or PNG file is expected") from None
    found: Any = None
    if path.suffix == ".npy":
        try:
            found = np.load(io.BytesIO(data), allow_pickle=False)
        except (ValueError, EOFError, OSError) as error:
            raise BadOptions(f"{key}: {path} is no NumPy file ({error})") from None
    elif data:
        found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if found is not None and found.ndim == 2:
            share = found.astype(np.float64) / np.iinfo(found.dtype).max
            found = terrain.black_m + (terrain.white_m - terrain.black_m) * share
    if found is None or found.ndim != 2 or found.dtype.kind not in "fiu":
        raise BadOptions(
            f"{key}: {path} holds no grey picture or table of numbers, expected rows and columns"
        )
    if not all(2 <= side <= MOST_SAMPLES for side in found.shape):
        raise BadOptions(f"{key}: {path} has {found.shape} samples, expected 2 to {MOST_SAMPLES} a side")
    heights = np.asarray(found, dtype=np.float64)
    if not np.isfinite(heights).all():
        raise BadOptions(f"{key}: {path} holds a height that is not finite, expected metres")
    if np.ptp(heights) > HIGHEST_M:
        raise BadOptions(
            f"{key}: {path} rises by {np.ptp(heights):g} m, expected {HIGHEST_M:g} m at most over the map"
        )
    return heights


def elevation_m(terrain: OwnTerrain, x_m: Float64, y_m: Float64) -> Float64:
    """Return elevations over the origin's, bilinear between samples, and fading to 0 beyond the edge.

    ``x_m`` and ``y_m`` broadcast against each other.
    """
    map_m = heights_m(terrain)
    row, column = _places(terrain, x_m, y_m)
    found = ndimage.map_coordinates(map_m, [row, column], order=1, mode="nearest")
    at_origin = ndimage.map_coordinates(map_m, [[v.item()] for v in _places(terrain, *np.zeros((2, 1)))],
                                        order=1, mode="nearest")  # fmt: skip
    part = np.clip(_beyond_m(terrain, map_m.shape, row, column) / FADE_M, 0.0, 1.0)
    return np.asarray((found - at_origin[0]) * (1.0 - part * part * (3.0 - 2.0 * part)))


def soil(terrain: OwnTerrain, x_m: Float64, y_m: Float64, cell_m: float, else_tones: Float32) -> Float32:
    """Return relative brightness of the ground: the picture's where it lies, ``else_tones`` elsewhere."""
    if not terrain.texture:
        return else_tones
    picture, _, _ = read_picture(terrain.texture, f"{KEY}.texture", Path())
    rows, columns = heights_m(terrain).shape
    # no finer than the ground's cells, each sample the mean of what it covers
    wanted = [max(1, round(side * terrain.m_per_px / cell_m)) for side in (columns, rows)]
    size = (min(wanted[0], picture.shape[1]), min(wanted[1], picture.shape[0]))
    tones = cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.float64)
    tones = np.clip(tones / max(float(tones.mean()), 1.0), 0.05, 3.5)
    row, column = _places(terrain, x_m, y_m)
    v, u = ((place + 0.5) * side / count - 0.5
            for place, side, count in ((row, size[1], rows), (column, size[0], columns)))  # fmt: skip
    found = ndimage.map_coordinates(tones, [v, u], order=1, mode="nearest")
    inside = _beyond_m(terrain, (rows, columns), row, column) <= terrain.m_per_px / 2
    return np.where(inside, found, else_tones).astype(np.float32)


def _places(terrain: OwnTerrain, x_m: Float64, y_m: Float64) -> tuple[Float64, Float64]:
    """Rows and columns of places."""
    row, column = np.broadcast_arrays(
        (terrain.origin_x_m - x_m) / terrain.m_per_px, (y_m - terrain.origin_y_m) / terrain.m_per_px
    )
    return row, column


def _beyond_m(terrain: OwnTerrain, shape: tuple[int, ...], row: Float64, column: Float64) -> Float64:
    """How far places lie beyond the outer samples."""
    over = [np.maximum(np.maximum(-at, at - (n - 1)), 0.0) for at, n in ((row, shape[0]), (column, shape[1]))]
    return np.asarray(np.hypot(*over) * terrain.m_per_px)
