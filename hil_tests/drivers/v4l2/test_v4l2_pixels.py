"""Formats to pictures: against numpy arithmetic, the colour standard's formula, and another JPEG decoder."""

from __future__ import annotations

import io

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image as PillowImage

from drivers import pixels
from drivers.errors import BadFrame
from drivers.pixels import PictureFormat

WIDTH, HEIGHT = 32, 24
ROUNDING_DN = 2  # two 8-bit roundings and a fixed-point matrix
JPEG_DN = 3  # decoders differ in their inverse transforms
NOISE = np.random.default_rng(5).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)


def picture_format(code: str, stride_bytes: int = 0, length_bytes: int = 0) -> PictureFormat:
    return PictureFormat(code, (WIDTH, HEIGHT), stride_bytes, length_bytes)


def bt601(y: int, u: int, v: int) -> NDArray[np.float64]:
    """Blue, green, red of limited-range BT.601, as ITU-R BT.601 writes it."""
    luma = 255 / 219 * (y - 16)
    blue = luma + 255 / 224 * 1.772 * (u - 128)
    red = luma + 255 / 224 * 1.402 * (v - 128)
    green = luma - 255 / 224 * (1.772 * 0.114 / 0.587 * (u - 128) + 1.402 * 0.299 / 0.587 * (v - 128))
    return np.clip([blue, green, red], 0, 255)


def test_padding_at_the_end_of_rows_is_left_out() -> None:
    padded = np.pad(NOISE, ((0, 0), (0, 16)), constant_values=77)
    assert np.array_equal(pixels.grey(picture_format("GREY", WIDTH + 16), padded.ravel()), NOISE)
    yuyv = np.stack([NOISE, np.full_like(NOISE, 128)], axis=-1).reshape(HEIGHT, -1)
    padded = np.pad(yuyv, ((0, 0), (0, 8)), constant_values=77)
    assert np.array_equal(pixels.grey(picture_format("YUYV", 2 * WIDTH + 8), padded.ravel()), NOISE)


@pytest.mark.parametrize(("code", "bits"), [("Y10", 10), ("Y12", 12), ("Y16", 16)])
def test_wide_grey_keeps_its_upper_eight_bits(code: str, bits: int) -> None:
    words = np.random.default_rng(bits).integers(0, 2**bits, (HEIGHT, WIDTH)).astype("<u2")
    image = pixels.grey(picture_format(code), words.view(np.uint8).ravel())
    assert np.array_equal(image, words // 2 ** (bits - 8))


def test_grey_of_yuyv_is_its_luma() -> None:
    raw = np.stack([NOISE, NOISE[::-1]], axis=-1)
    assert np.array_equal(pixels.grey(picture_format("YUYV"), raw.ravel()), NOISE)


def packed(samples: NDArray[np.uint16], bits: int) -> NDArray[np.uint8]:
    """As the kernel's pages of SRGGB10P and SRGGB12P draw it: upper bytes, then all their low bits."""
    if bits == 10:
        a, b, c, d = (samples[:, k::4] for k in range(4))
        columns = [a >> 2, b >> 2, c >> 2, d >> 2, (d & 3) << 6 | (c & 3) << 4 | (b & 3) << 2 | a & 3]
    else:
        a, b = samples[:, 0::2], samples[:, 1::2]
        columns = [a >> 4, b >> 4, (b & 15) << 4 | a & 15]
    return np.stack(columns, axis=-1).reshape(len(samples), -1).astype(np.uint8)


@pytest.mark.parametrize("padding", [0, 7])
@pytest.mark.parametrize(("code", "bits"), [("Y10P", 10), ("Y12P", 12)])
def test_packed_grey_keeps_its_upper_eight_bits(code: str, bits: int, padding: int) -> None:
    samples = np.random.default_rng(bits).integers(0, 2**bits, (HEIGHT, WIDTH)).astype(np.uint16)
    rows = np.pad(packed(samples, bits), ((0, 0), (0, padding)), constant_values=77)
    image = pixels.grey(picture_format(code, rows.shape[1]), rows.ravel())
    assert np.array_equal(image, samples // 2 ** (bits - 8))
    assert not np.shares_memory(image, rows)
    assert np.array_equal(pixels.colour(picture_format(code, rows.shape[1]), rows.ravel())[..., 1], image)


def test_packed_rows_end_in_a_group_that_is_not_full() -> None:
    """Three columns of five bytes a row, by hand: the fourth sample is padding."""
    raw = np.array([1, 2, 3, 99, 255, 4, 5, 6, 99, 0], np.uint8)
    form = PictureFormat("Y10P", (3, 2), 0, 10)
    assert pixels.least_bytes(form) == 10
    assert pixels.grey(form, raw).tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize(("y", "u", "v"), [(16, 128, 128), (235, 128, 128), (81, 90, 240), (120, 200, 60)])
@pytest.mark.parametrize("code", ["YUYV", "UYVY", "NV12"])
def test_colour_follows_the_standard(code: str, y: int, u: int, v: int) -> None:
    if code == "YUYV":
        raw = np.tile(np.array([y, u, y, v], np.uint8), WIDTH * HEIGHT // 2)
    elif code == "UYVY":
        raw = np.tile(np.array([u, y, v, y], np.uint8), WIDTH * HEIGHT // 2)
    else:
        chroma = np.tile(np.array([u, v], np.uint8), WIDTH * HEIGHT // 4)
        raw = np.concatenate([np.full(WIDTH * HEIGHT, y, np.uint8), chroma])
    image = pixels.colour(picture_format(code), raw)
    assert image.shape == (HEIGHT, WIDTH, 3)
    assert np.abs(image.astype(float) - bt601(y, u, v)).max() <= ROUNDING_DN
    assert (pixels.grey(picture_format(code), raw) == y).all()


def test_red_first_and_blue_first_show_the_same_with_padded_rows() -> None:
    blue_first = np.random.default_rng(8).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    for code, rows in (("BGR3", blue_first), ("RGB3", blue_first[:, :, ::-1])):
        raw = np.pad(rows.reshape(HEIGHT, -1), ((0, 0), (0, 8))).ravel()
        form = PictureFormat(code, (WIDTH, HEIGHT), 3 * WIDTH + 8, len(raw))
        assert np.array_equal(pixels.colour(form, raw), blue_first)
        assert np.array_equal(pixels.grey(form, raw), cv2.cvtColor(blue_first, cv2.COLOR_BGR2GRAY))


@pytest.mark.parametrize("code", [c for c, layout in pixels.FORMATS.items() if layout.kind == "bayer"])
def test_an_evenly_coloured_bayer_picture_has_that_colour(code: str) -> None:
    colour = {"R": 200, "G": 120, "B": 40}
    layout = pixels.FORMATS[code]
    mosaic = np.empty((HEIGHT, WIDTH), np.uint16)
    for place, letter in enumerate(layout.order):  # of the kernel: the first row, then the second
        mosaic[place // 2 :: 2, place % 2 :: 2] = colour[letter] << (layout.bits - 8)
    raw = mosaic.astype(np.uint8) if layout.bits == 8 else mosaic.astype("<u2").view(np.uint8)
    if code in ("pBAA", "pGAA", "pgAA", "pRAA", "pBCC", "pGCC", "pgCC", "pRCC"):
        raw = packed(mosaic, layout.bits)
    image = pixels.colour(picture_format(code), raw.ravel())
    assert (image == [40, 120, 200]).all()
    grey = pixels.grey(picture_format(code), raw.ravel())
    assert np.abs(grey.astype(float) - (0.299 * 200 + 0.587 * 120 + 0.114 * 40)).max() <= ROUNDING_DN


def smooth_jpeg() -> bytes:
    x = np.linspace(20, 230, WIDTH)
    y = np.linspace(0.5, 1.0, HEIGHT)[:, None]
    picture = np.stack([x * y, 250 - x * y, 0 * x + 128 * y], axis=-1).astype(np.uint8)
    return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 95])[1])


def test_a_jpeg_is_what_another_decoder_makes_of_it() -> None:
    data = smooth_jpeg()
    raw = np.frombuffer(data, np.uint8)
    with PillowImage.open(io.BytesIO(data)) as opened:
        rgb, luma = np.asarray(opened.convert("RGB")), np.asarray(opened.convert("YCbCr"))[..., 0]
    assert np.abs(pixels.colour(picture_format("MJPG"), raw)[..., ::-1].astype(int) - rgb).max() <= JPEG_DN
    assert np.abs(pixels.grey(picture_format("MJPG"), raw).astype(int) - luma).max() <= JPEG_DN


def test_a_jpeg_is_kept_as_it_came_without_what_fills_it_up() -> None:
    data = smooth_jpeg()
    raw = np.frombuffer(bytes(data) + b"\0" * 300, np.uint8)
    assert pixels.jpeg_of(picture_format("MJPG"), raw) == bytes(data)
    assert pixels.jpeg_of(picture_format("GREY"), raw) == b""


def test_a_jpeg_of_another_size_is_refused() -> None:
    raw = np.frombuffer(smooth_jpeg(), np.uint8)
    with pytest.raises(BadFrame, match=r"a JPEG of 32x24 px where \(64, 48\) px were set"):
        pixels.grey(PictureFormat("MJPG", (64, 48), 0, 10000), raw)


@pytest.mark.parametrize(
    ("code", "good_bytes"),
    [
        ("GREY", 768),
        ("NV12", 1152),
        ("Y10P", 960),
        ("pRCC", 1152),
    ],
)
def test_a_picture_that_is_too_short_is_found(code: str, good_bytes: int) -> None:
    form = picture_format(code, 0, good_bytes + 64)
    assert pixels.wrong_length(form, memoryview(bytes(good_bytes))) == ""
    assert (
        pixels.wrong_length(form, memoryview(bytes(good_bytes + 64))) == ""
    )  # padded to the buffer's length
    words = pixels.wrong_length(form, memoryview(bytes(good_bytes - 2)))
    assert words == f"{good_bytes - 2} bytes where {good_bytes} are expected"


def test_a_cut_off_jpeg_is_found() -> None:
    form, data = picture_format("MJPG", 0, 100000), smooth_jpeg()
    assert pixels.wrong_length(form, memoryview(data)) == ""
    for padding in (300, 50000):  # filled up by the camera, to its packets or to its buffer
        assert pixels.wrong_length(form, memoryview(data + bytes(padding))) == ""
    assert "cut off" in pixels.wrong_length(form, memoryview(data[: len(data) // 2]))
    lost = data[: len(data) // 2] + data[-2:]
    assert pixels.wrong_length(form, memoryview(lost)) == ""
    with pytest.raises(BadFrame, match="cut short or damaged"):
        pixels.grey(form, np.frombuffer(lost, np.uint8))
    assert "no JPEG" in pixels.wrong_length(form, memoryview(data[10:]))
    assert "no JPEG" in pixels.wrong_length(form, memoryview(b""))
