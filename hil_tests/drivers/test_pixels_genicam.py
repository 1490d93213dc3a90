"""GenICam's packed formats against bits laid out by hand, as its naming convention draws them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers import pixels
from drivers.pixels import PictureFormat

WIDTH, HEIGHT = 8, 6


def samples(bits: int) -> NDArray[np.int64]:
    return np.random.default_rng(bits).integers(0, 2**bits, (HEIGHT, WIDTH))


def stream_of_bits(values: NDArray[np.int64], bits: int) -> NDArray[np.uint8]:
    """Lowest bit first, sample after sample (Mono10p, Mono12p)."""
    ones = [value >> bit & 1 for value in values.ravel().tolist() for bit in range(bits)]
    return np.packbits(np.array(ones, np.uint8), bitorder="little")


def gige_packed(values: NDArray[np.int64], bits: int) -> NDArray[np.uint8]:
    """Upper byte, the low bits of both in one byte, upper byte (Mono10Packed, Mono12Packed)."""
    low, found = bits - 8, []
    for a, b in values.reshape(-1, 2).tolist():
        rests = (a & (1 << low) - 1) | (b & (1 << low) - 1) << 4
        found += [a >> low, rests, b >> low]
    return np.array(found, np.uint8)


@pytest.mark.parametrize("bits", [10, 12])
@pytest.mark.parametrize(("ending", "lay"), [("p", stream_of_bits), ("Packed", gige_packed)])
def test_packed_grey_keeps_its_upper_eight_bits(bits: int, ending: str, lay: object) -> None:
    values = samples(bits)
    raw = lay(values, bits)  # type: ignore[operator]
    format = PictureFormat(f"Mono{bits}{ending}", (WIDTH, HEIGHT), 0, len(raw))
    assert pixels.least_bytes(format) == len(raw)
    assert np.array_equal(pixels.grey(format, raw), values >> bits - 8)


@pytest.mark.parametrize(("name", "code"), [("BayerRG8", "RGGB"), ("BayerGB8", "GBRG"), ("Mono16", "Y16")])
def test_the_same_samples_make_the_same_picture_as_through_v4l2(name: str, code: str) -> None:
    size = WIDTH * HEIGHT * (2 if name == "Mono16" else 1)
    raw = np.random.default_rng(3).integers(0, 256, size, dtype=np.uint8)
    there = pixels.colour(PictureFormat(code, (WIDTH, HEIGHT), 0, size), raw)
    assert np.array_equal(pixels.colour(PictureFormat(name, (WIDTH, HEIGHT), 0, size), raw), there)
