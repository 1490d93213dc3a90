"""All rays of a camera, made once: from the model itself, between its exact rays where it is smooth."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from calib.geometry.cahvor import CameraModel
from drivers.sim.compiled import kernels

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

TILE_PX = 16  # squares for which rocks and the distance to the ground are bounded first...
BLOCK_PX = 4  # ...and then more closely
NODES = 24
CHECKS = 41
MOST_APART = 1e-9  # a thousandth of float32's rounding of a direction


class RayTable(NamedTuple):
    """All rays of one camera model in the model's own frame, and beams that hold them, tile by tile.

    rays (h, w, q, 3) unit directions, q = samples ** 2 in rows, not-a-number where the model has none; starts
    (h, w, q, 3) where each ray begins relative to C, metres, or (0, 0, 0, 3) if all begin at C; beams of
    tiles and of blocks (rows, columns, 6) as ``kernels.render_tiles`` wants them.

    Directions are float32: in a frame whose x axis is near the optical axis, as mast files have it, the
    rounding is below 1e-4 px at a focal length of 3441 px.
    """

    rays: Float32
    starts: Float32
    tile_beams: Float64
    block_beams: Float64


def ray_table(camera: CameraModel, samples: int) -> RayTable:
    """Return the rays through every sample of every pixel of ``camera``, as the model gives them."""
    width, height = camera.size_px
    x_px, y_px = (sample_places(count, samples) for count in (width, height))
    found = interpolated(camera, x_px, y_px)
    if found is None:
        found = exact(camera, x_px, y_px)
    rays, starts = (in_pixels(part, samples) for part in found)
    return RayTable(rays, starts, *(beams(rays, starts, samples, size) for size in (TILE_PX, BLOCK_PX)))


def sample_places(count: int, samples: int) -> Float64:
    """Return (count * samples,) the places of samples along a side of ``count`` pixels."""
    return (np.arange(count * samples) + 0.5) / samples - 0.5


def exact(camera: CameraModel, x_px: Float64, y_px: Float64) -> tuple[Float32, Float32]:
    """Directions and starts (rows, columns, 3) of the rays at every (x, y), from the model itself."""
    rays = np.empty((len(y_px), len(x_px), 3), dtype=np.float32)
    starts = np.zeros_like(rays)
    for row in range(0, len(y_px), 64):
        part = slice(row, row + 64)
        origins_m, directions, valid = camera.ray(np.stack(np.meshgrid(x_px, y_px[part]), axis=-1))
        rays[part] = np.where(valid[..., None], directions, np.nan)
        starts[part] = np.where(valid[..., None], origins_m - camera.C, 0.0)
    return rays, starts if starts.any() else starts[:0, :0]


def interpolated(camera: CameraModel, x_px: Float64, y_px: Float64) -> tuple[Float32, Float32] | None:
    """As `exact`, by polynomials through the model's rays at Chebyshev's nodes; None if that is not exact.

    A lens is a smooth function over the whole picture. Whether it is for this camera is tried at places
    between the nodes; a model without a ray somewhere is left to `exact`.
    """
    spans = [(places[0], places[-1]) for places in (x_px, y_px)]
    nodes = chebyshev.chebpts1(NODES)
    between = np.linspace(-1.0, 1.0, CHECKS)
    at_nodes, at_checks = (rays_at(camera, spans, places) for places in (nodes, between))
    if at_nodes is None or at_checks is None:
        return None
    to_series = np.linalg.inv(chebyshev.chebvander(nodes, NODES - 1))
    series = np.einsum("iy,jx,yxk->kij", to_series, to_series, at_nodes, optimize=True)
    check = chebyshev.chebvander(between, NODES - 1)
    if np.abs(check @ series @ check.T - at_checks.transpose(2, 0, 1)).max() > MOST_APART:
        return None
    in_x, in_y = (
        chebyshev.chebvander(2.0 * (places - low) / (high - low) - 1.0, NODES - 1)
        for places, (low, high) in zip((x_px, y_px), spans, strict=True)
    )
    used = 6 if at_nodes[..., 3:].any() else 3
    out = np.empty((len(y_px), len(x_px), used), dtype=np.float32)
    for k in range(used):
        out[..., k] = (in_y @ series[k]) @ in_x.T
    return out[..., :3], out[..., 3:] if used == 6 else np.empty((0, 0, 3), dtype=np.float32)


def rays_at(camera: CameraModel, spans: list[tuple[float, float]], places: Float64) -> Float64 | None:
    """Directions and starts (n, n, 6) at places (n,) from -1 to 1 across the picture, if all have a ray."""
    x_px, y_px = (low + (places + 1.0) * 0.5 * (high - low) for low, high in spans)
    origins_m, directions, valid = camera.ray(np.stack(np.meshgrid(x_px, y_px), axis=-1))
    if not valid.all():
        return None
    return np.concatenate([directions, origins_m - camera.C], axis=-1)


def in_pixels(values: Float32, samples: int) -> Float32:
    """(rows, columns, 3) of samples as (h, w, samples ** 2, 3)."""
    rows, columns = values.shape[:2]
    if rows == 0:
        return np.empty((0, 0, 0, 3), dtype=np.float32)
    cut = values.reshape(rows // samples, samples, columns // samples, samples, 3).transpose(0, 2, 1, 3, 4)
    return np.ascontiguousarray(cut).reshape(rows // samples, columns // samples, samples**2, 3)


def beams(rays: Float32, starts: Float32, samples: int, size_px: int) -> Float64:
    """Return (rows, columns, 6): the mean direction of each square of pixels, and how far its rays spread."""
    table = np.empty((-(-rays.shape[0] // size_px), -(-rays.shape[1] // size_px), 6))
    kernels().hold_rays(rays, starts, samples, size_px, table)
    return table
