"""From light to a frame's bytes: gain, a colour filter over each pixel, noise, grey levels, and JPEG."""

from __future__ import annotations

import functools
import zlib
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from scipy.special import ndtri

from drivers.interfaces import Image
from drivers.sim.compiled import kernels
from drivers.sim.optics.exposure import FrameExposure
from drivers.sim.optics.lens import Float32

SEEN = np.array([0.55, 1.0, 0.6], dtype=np.float32)
"""What a pixel under a red, green, blue filter makes of the same white light; its balance is undone after."""

TINT = np.array([1.0, 0.86, 0.70], dtype=np.float32)
"""Red, green and blue of the scene's light over what it is drawn with: dry ground."""


@functools.cache
def bell() -> Float32:
    """Return (65536,) deviates of the normal distribution, each as likely as the others."""
    return np.asarray(ndtri((np.arange(65536) + 0.5) / 65536), dtype=np.float32)


@dataclass(frozen=True)
class Noise:
    """The noise of one camera; seed, camera and a frame's sequence number fix every pixel."""

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


@dataclass(frozen=True)
class Readout:
    """How one camera reads its sensor: with its noise at gain 1.

    With ``colour`` its pixels lie under red, green and blue filters (RGGB), and its pictures are (h, w, 3)
    BGR.
    """

    noise: Noise
    colour: bool = False
    jpeg_quality: int = 0
    _kept: list[tuple[Float32, FrameExposure, Float32, Float32]] = field(default_factory=list, repr=False)

    def picture(self, light: Float32, sequence: int, shot: FrameExposure) -> Image:
        """Return frame ``sequence``, uint8 (h, w) or (h, w, 3) BGR, of the light (h, w) on the sensor."""
        levels, sigma_dn = self._levels(light, shot)
        raw = self.noise.levels(levels, sigma_dn, sequence)
        image = self._demosaiced(raw) if self.colour else raw
        if not self.jpeg_quality:
            return image
        _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality])
        how = cv2.IMREAD_COLOR if self.colour else cv2.IMREAD_GRAYSCALE
        return np.asarray(cv2.imdecode(data, how), dtype=np.uint8)

    def _levels(self, light: Float32, shot: FrameExposure) -> tuple[Float32, Float32]:
        """Grey levels without noise, and the noise's deviation; kept for light that comes again."""
        for one, with_shot, levels, sigma_dn in self._kept:
            if one is light and with_shot == shot:
                return levels, sigma_dn
        levels = light if shot.factor == 1.0 else light * np.float32(shot.factor)
        if self.colour:
            levels = levels * _filters(levels.shape[0], levels.shape[1])
        noise = self.noise
        if shot.gain != 1.0:
            noise = replace(noise, read_dn=noise.read_dn * shot.gain, shot_dn=noise.shot_dn * shot.gain**0.5)
        sigma_dn = noise.sigma_dn(levels)
        self._kept.clear()
        if not light.flags.writeable:  # a head at rest gives the same array again and again
            self._kept.append((light, shot, levels, sigma_dn))
        return levels, sigma_dn

    @staticmethod
    def _demosaiced(raw: Image) -> Image:
        """Colour of each pixel from the filters around it, with red and blue brought up to green."""
        blue_green_red = cv2.cvtColor(raw, cv2.COLOR_BayerRGGB2BGR).astype(np.float32)
        balanced: Image = np.rint(np.clip(blue_green_red / SEEN[::-1], 0, 255)).astype(np.uint8)
        return balanced


def _filters(height: int, width: int) -> Float32:
    """(h, w) what the filter over each pixel lets through of the scene's light."""
    red, green, blue = SEEN * TINT
    share = np.full((height, width), green, dtype=np.float32)
    share[0::2, 0::2] = red
    share[1::2, 1::2] = blue
    return share
