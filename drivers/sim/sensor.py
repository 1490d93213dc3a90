"""From light to grey levels: the noise of a simulated camera."""

from __future__ import annotations

import functools
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from drivers.interfaces import Image
from drivers.sim.compiled import kernels

Float32 = NDArray[np.float32]


@functools.cache
def bell() -> Float32:
    """Return (65536,) deviates of the normal distribution, each as likely as the others."""
    return np.asarray(ndtri((np.arange(65536) + 0.5) / 65536), dtype=np.float32)


@dataclass(frozen=True)
class Noise:
    """The noise of one camera.

    Attributes
    ----------
    read_dn
        Standard deviation in the dark, grey levels of 0..255.
    shot_dn
        Standard deviation that light adds at mid grey (128); grows as the root of the grey level.
    seed
        With ``camera`` and a frame's sequence number it fixes every pixel.
    camera
        The camera's name.
    """

    read_dn: float
    shot_dn: float
    seed: int
    camera: str

    def sigma_dn(self, light: Float32) -> Float32:
        """Return the standard deviation of each pixel of a noise-free picture, grey levels."""
        variance = self.read_dn**2 + self.shot_dn**2 / 128 * np.maximum(light, np.float32(0))
        return np.sqrt(variance, dtype=np.float32)

    def levels(self, light: Float32, sigma_dn: Float32, sequence: int) -> Image:
        """Return the picture (h, w) of frame ``sequence`` in whole grey levels."""
        words = np.random.SeedSequence([self.seed, zlib.crc32(self.camera.encode()), sequence])
        image: Image = np.empty(light.shape, dtype=np.uint8)
        kernels().noisy_levels(
            np.ascontiguousarray(light).ravel(),
            np.ascontiguousarray(sigma_dn).ravel(),
            bell(),
            words.generate_state(1, np.uint64)[0],
            image.reshape(-1),
        )
        return image
