"""Smooth functions of the pixel, known at the nodes of a mesh and bilinear between them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


def nodes(count: int, step_px: int) -> Float64:
    """Return places of nodes along a side of ``count`` pixels, from its first to its last, evenly spread."""
    return np.linspace(0.0, count - 1.0, max(2, -(-(count - 1) // step_px) + 1))


def between(places: Float64, first: int, last: int) -> Float32:
    """Return (last - first, nodes): what the nodes weigh at pixels [first, last), linear between nodes."""
    away = np.abs(np.arange(first, last)[:, None] - places) / (places[1] - places[0])
    return np.asarray(np.clip(1.0 - away, 0.0, None), dtype=np.float32)


def pixels_of(x_px: Float64, y_px: Float64) -> Float64:
    """Return (rows, columns, 2) pixels of a mesh."""
    return np.stack(np.meshgrid(x_px, y_px), axis=-1)
