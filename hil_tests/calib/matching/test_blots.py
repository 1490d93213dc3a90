"""Matches where one picture shows what the other does not: dust on the lens, a reflection."""

from __future__ import annotations

import cv2
import numpy as np

from calib.geometry.cahvor import CameraModel
from calib.matching.patch import MatchSettings, match_patch
from calib.matching.warp import PosedImage, facing_plane

SIZE_PX = (160, 160)
CAMERA = CameraModel("CAHV", SIZE_PX, C=[0, 0, 0], A=[1, 0, 0], H=[79.5, 600, 0], V=[79.5, 0, 600])
NOISE_DN = 2.0
DUST_PX, DUST_SHARE = 5.0, 0.4
"""One sigma of a spot's radius, and how much light it takes away in its middle."""

SHIFTED_PX = 0.14
"""Rms; without regard to the dust it is 0.20."""


def test_dust_beside_a_target_hardly_shifts_it() -> None:
    errors = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        fine, broad = (cv2.GaussianBlur(rng.normal(0.0, 1.0, SIZE_PX), (0, 0), size) for size in (1.5, 8.0))
        scene = 110.0 + 60.0 * fine + 400.0 * broad  # a rock: shades, and little texture
        x, y = np.meshgrid(np.arange(SIZE_PX[0]), np.arange(SIZE_PX[1]))
        target = rng.uniform(75.0, 85.0, 2)
        at = target + rng.uniform(-14.0, 14.0, 2)
        dust = 1.0 - DUST_SHARE * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2.0 * DUST_PX**2))
        first, second = (
            (light + rng.normal(0.0, NOISE_DN, SIZE_PX)).astype(np.float32) for light in (scene, scene * dust)
        )
        plane = facing_plane(CAMERA, target, 5.0)
        images = PosedImage(first, CAMERA), PosedImage(second, CAMERA)
        found = match_patch(images[0], target, plane, images[1], 8.0, MatchSettings(roughness=0.0))
        assert found.verdict == "good", found.reason
        errors.append(found.pixel_px - target)
    assert np.sqrt(np.mean(np.square(errors))) < SHIFTED_PX
