"""Corners of a board as one image shows them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.rigid import FloatArray

IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners of one board in one image; arrays are read-only.

    Attributes
    ----------
    ids
        (n,) as the board counts them, each once.
    pixels_px
        (n, 2); the centre of the top-left pixel is (0, 0). Of a dot: the image of its centre.
    sigma_px
        (n,) one standard deviation of a corner, each axis.
    """

    ids: IntArray
    pixels_px: FloatArray
    sigma_px: FloatArray

    def __post_init__(self) -> None:
        ids = np.array(self.ids, dtype=np.int64).reshape(-1)
        pixels = np.array(self.pixels_px, dtype=np.float64).reshape(-1, 2)
        sigma = np.array(self.sigma_px, dtype=np.float64).reshape(-1)
        if not len(ids) == len(pixels) == len(sigma):
            raise ValueError(
                f"{len(ids)} ids, {len(pixels)} pixels and {len(sigma)} sigmas do not go together"
            )
        for name, array in (("ids", ids), ("pixels_px", pixels), ("sigma_px", sigma)):
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return len(self.ids)
