"""GenICam's names of formats: each is the picture of V4L2's format of the same samples."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import pixels
from drivers.pixels import PictureFormat

WIDTH, HEIGHT = 8, 6


@pytest.mark.parametrize(("name", "code"), [("BayerRG8", "RGGB"), ("BayerGB8", "GBRG"), ("Mono16", "Y16")])
def test_the_same_samples_make_the_same_picture_as_through_v4l2(name: str, code: str) -> None:
    size = WIDTH * HEIGHT * (2 if name == "Mono16" else 1)
    raw = np.random.default_rng(3).integers(0, 256, size, dtype=np.uint8)
    there = pixels.colour(PictureFormat(code, (WIDTH, HEIGHT), 0, size), raw)
    assert np.array_equal(pixels.colour(PictureFormat(name, (WIDTH, HEIGHT), 0, size), raw), there)
