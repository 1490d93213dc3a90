"""Ground of one's own: a height map, and a picture of the same ground, laid over the middle of the scene.

Maps are north up: rows go south, columns east. Heights are metres upwards, counted from the ground at the
site's origin, where the rover stands.
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
from scipy import ndimage

from drivers.errors import BadOptions
from drivers.sim.placed import read_picture
from drivers.sim.section import check_bounds, filled

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]

KEY = "simulation.scene.terrain"
MOST_SAMPLES = 8192
HIGHEST_M = 30.0
FADE_M = 2.0
"""Beyond the map's edge the ground goes back to the height of the origin within so far."""


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


_BOUNDS = {
    "m_per_px": (0.005, 20.0),
    "origin_x_m": (-1e4, 1e4),
    "origin_y_m": (-1e4, 1e4),
    "black_m": (-1e4, 1e4),
    "white_m": (-1e4, 1e4),
}


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
    check_bounds(terrain, _BOUNDS, KEY)
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
