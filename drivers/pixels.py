"""Formats of pictures: how many bytes there must be, the grey picture, and the colour picture.

Formats of more than 8 bits keep their upper 8. Bayer formats are demosaiced by OpenCV; raw 16-bit words are
little-endian with the value in the low bits, as the kernel and GenICam define them. Packed formats are MIPI
CSI-2 RAW10 and RAW12: the upper 8 bits of four or two samples stand first, then one byte with the rest of
them all. GenICam's own packed formats are not read: such a camera has an 8-bit format too.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.files.pictures import decode_picture
from drivers.errors import BadFrame
from drivers.interfaces import Image


@dataclass(frozen=True)
class PictureFormat:
    """A picture's format, as the camera's driver set it.

    ``stride_bytes`` is from one row to the next, of the first plane, 0 for compressed formats; ``field`` is 1
    for whole pictures, others are interlaced; ``planes_bytes`` the most that each plane takes, where the
    camera captures in planes of their own.
    """

    code: str
    size_px: tuple[int, int]
    stride_bytes: int
    length_bytes: int
    field: int = 1
    planes_bytes: tuple[int, ...] = ()


Kind = Literal["grey", "bayer", "yuyv", "uyvy", "nv12", "jpeg", "rgb", "bgr"]


@dataclass(frozen=True)
class Layout:
    """How a format is laid out: of a Bayer format ``order`` has the colours of the first two by two samples.

    ``packed``: the samples that share one byte more than they are; 0 for samples that stand in whole bytes.
    """

    kind: Kind
    bits: int = 8
    order: str = ""
    packed: int = 0


_ORDERS = ("BGGR", "GBRG", "GRBG", "RGGB")
_BAYER = {
    (8, 0): "BA81 GBRG GRBG RGGB", (10, 0): "BG10 GB10 BA10 RG10", (12, 0): "BG12 GB12 BA12 RG12",
    (16, 0): "BYR2 GB16 GR16 RG16", (10, 4): "pBAA pGAA pgAA pRAA", (12, 2): "pBCC pGCC pgCC pRCC",
}  # fmt: skip
"""Of V4L2, by bits and samples that share a byte, in these orders."""

FORMATS = MappingProxyType(
    {
        "GREY": Layout("grey"),
        "Y10": Layout("grey", 10),
        "Y12": Layout("grey", 12),
        "Y16": Layout("grey", 16),
        "Y10P": Layout("grey", 10, packed=4),
        "Y12P": Layout("grey", 12, packed=2),
        "YUYV": Layout("yuyv"),
        "UYVY": Layout("uyvy"),
        "NV12": Layout("nv12"),
        "NM12": Layout("nv12"),  # luma and chroma in planes of their own
        "RGB3": Layout("rgb"),
        "BGR3": Layout("bgr"),
        "MJPG": Layout("jpeg"),
        "JPEG": Layout("jpeg"),
        **{
            code: Layout("bayer", bits, order, packed)
            for (bits, packed), codes in _BAYER.items()
            for code, order in zip(codes.split(), _ORDERS, strict=True)
        },
    }
)
"""Of V4L2, by four-character code."""


def _genicam() -> dict[str, Layout]:
    """The formats by their names in GenICam's Pixel Format Naming Convention, and in GigE Vision 1."""
    found = {
        "RGB8": Layout("rgb"), "RGB8Packed": Layout("rgb"),
        "BGR8": Layout("bgr"), "BGR8Packed": Layout("bgr"),
        "YUV422_8": Layout("yuyv"), "YCbCr422_8": Layout("yuyv"),
        "YUV422_8_UYVY": Layout("uyvy"), "YUV422Packed": Layout("uyvy"),
    }  # fmt: skip
    orders = {f"Bayer{order[:2]}": order for order in _ORDERS}
    for name, order in {"Mono": "", **orders}.items():
        kind: Kind = "bayer" if order else "grey"
        for bits in (8, 10, 12, 14, 16):
            found[f"{name}{bits}"] = Layout(kind, bits, order)
    return found


GENICAM = MappingProxyType(_genicam())
_LAYOUTS = MappingProxyType({**FORMATS, **GENICAM})

_JPEG_BEGIN, _JPEG_END = b"\xff\xd8", b"\xff\xd9"


def least_bytes(format: PictureFormat) -> int:
    """Return the bytes of the picture itself, without padding at its end; 0 for compressed formats."""
    width, height = format.size_px
    layout = _LAYOUTS[format.code]
    if layout.kind == "jpeg":
        return 0
    if layout.kind == "nv12":
        return _stride(format, width) * (height + (height + 1) // 2)
    return _stride(format, _row_bytes(layout, width)) * height


def whole_lengths(format: PictureFormat) -> tuple[int, ...]:
    """Return the lengths in bytes that a whole picture may have; none where only its content shows it."""
    least = least_bytes(format)
    return (least, format.length_bytes) if least else ()


def wrong_length(format: PictureFormat, data: memoryview) -> str:
    """Return what is wrong with the length, or a JPEG's ends, of a picture's bytes; empty if nothing."""
    if lengths := whole_lengths(format):
        return "" if len(data) in lengths else f"{len(data)} bytes where {lengths[0]} are expected"
    if bytes(data[:2]) != _JPEG_BEGIN:
        return "no JPEG: it does not begin like one"
    tail = bytes(data[-256:]).rstrip(b"\0")  # some cameras fill up with zeros
    whole = (tail or bytes(data).rstrip(b"\0")).endswith(_JPEG_END)
    return "" if whole else f"a JPEG cut off after {len(data)} bytes"


def jpeg_of(format: PictureFormat, raw: NDArray[np.uint8]) -> bytes:
    """Return the JPEG that a picture's bytes are, without what fills them up; empty for other formats."""
    if _LAYOUTS[format.code].kind != "jpeg":
        return b""
    return raw.tobytes().rstrip(b"\0")


def grey(format: PictureFormat, raw: NDArray[np.uint8]) -> Image:
    """Return the grey picture, uint8 (h, w), in memory of its own. Raises BadFrame for a broken JPEG.

    The code must be among `FORMATS` or `GENICAM`; ``raw`` are the bytes of one picture, uint8 (n,).
    """
    layout = _LAYOUTS[format.code]
    if layout.kind == "jpeg":
        return _decoded(format, raw, cv2.IMREAD_GRAYSCALE)
    if layout.kind in ("yuyv", "uyvy"):
        width, height = format.size_px
        stride = _stride(format, 2 * width)
        words = raw[: stride * height].reshape(height, stride)[:, : 2 * width].view("<u2")
        if layout.kind == "uyvy":
            words = words >> 8
        return words.astype(np.uint8)  # keeps the low byte, the luma; seven times as fast as extractChannel
    if layout.kind == "nv12":
        width, height = format.size_px
        stride = _stride(format, width)
        return raw[: stride * height].reshape(height, stride)[:, :width].copy()
    if layout.kind in ("rgb", "bgr"):
        return _image(cv2.cvtColor(_rows(format, raw, 3), getattr(cv2, f"COLOR_{layout.kind.upper()}2GRAY")))
    samples = _samples(format, layout, raw)
    if layout.kind == "bayer":
        return _image(cv2.cvtColor(samples, getattr(cv2, f"COLOR_Bayer{layout.order}2GRAY")))
    return samples.copy() if layout.bits == 8 else samples  # wider ones are in memory of their own


def colour(format: PictureFormat, raw: NDArray[np.uint8]) -> Image:
    """Return the colour picture, uint8 (h, w, 3) BGR; of a grey format the grey three times. Like `grey`."""
    layout = _LAYOUTS[format.code]
    if layout.kind == "jpeg":
        return _decoded(format, raw, cv2.IMREAD_COLOR)
    if layout.kind in ("yuyv", "uyvy"):
        code = cv2.COLOR_YUV2BGR_UYVY if layout.kind == "uyvy" else cv2.COLOR_YUV2BGR_YUY2
        return _image(cv2.cvtColor(_rows(format, raw, 2), code))
    if layout.kind == "nv12":
        width, height = format.size_px
        stride = _stride(format, width)
        least = stride * height
        # The first plane of several may be padded at its end, as `whole_lengths` allows.
        padded = len(format.planes_bytes) > 1 and len(raw) == format.length_bytes
        luma, chroma = raw[:least], raw[format.planes_bytes[0] if padded else least :]
        chroma = chroma[: stride * ((height + 1) // 2)].reshape(-1, stride // 2, 2)[:, : width // 2]
        luma = luma.reshape(height, stride)[:, :width]
        return _image(cv2.cvtColorTwoPlane(luma, chroma, cv2.COLOR_YUV2BGR_NV12))
    if layout.kind == "bgr":
        return _rows(format, raw, 3).copy()
    if layout.kind == "rgb":
        return _image(cv2.cvtColor(_rows(format, raw, 3), cv2.COLOR_RGB2BGR))
    samples = _samples(format, layout, raw)
    if layout.kind == "bayer":
        return _image(cv2.cvtColor(samples, getattr(cv2, f"COLOR_Bayer{layout.order}2BGR")))
    return _image(cv2.cvtColor(samples, cv2.COLOR_GRAY2BGR))


def _rows(format: PictureFormat, raw: NDArray[np.uint8], channels: int) -> NDArray[np.uint8]:
    """The picture as (h, w, channels), its rows where they are."""
    width, height = format.size_px
    stride = _stride(format, width * channels)
    rows = raw[: stride * height].reshape(height, stride)[:, : width * channels]
    return rows.reshape(height, width, channels) if stride == width * channels else _packed(rows, channels)


def _packed(rows: NDArray[np.uint8], channels: int) -> NDArray[np.uint8]:
    """Rows without the padding at their ends."""
    return np.ascontiguousarray(rows).reshape(rows.shape[0], -1, channels)


def _samples(format: PictureFormat, layout: Layout, raw: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """One sample a pixel, its upper 8 bits, (h, w)."""
    width, height = format.size_px
    stride = _stride(format, _row_bytes(layout, width))
    rows = raw[: stride * height].reshape(height, stride)[:, : _row_bytes(layout, width)]
    if layout.packed:
        # The upper bytes of a group as one number: thirty times as fast as a slice of three dimensions.
        group = np.dtype([("upper", f"<u{layout.packed}"), ("rests", "u1")])
        upper = np.ascontiguousarray(rows.view(group)["upper"]).view(np.uint8)
        return np.ascontiguousarray(upper[:, :width])
    if layout.bits == 8:
        return rows
    if layout.bits == 16:
        return rows[:, 1::2].copy()
    words = rows.view("<u2") >> (layout.bits - 8)
    return _image(np.minimum(words, 255, out=words).astype(np.uint8))


def _decoded(format: PictureFormat, raw: NDArray[np.uint8], flags: int) -> Image:
    """A JPEG's picture, of the size that the driver promised."""
    try:
        image = decode_picture(raw.tobytes(), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except ValueError as error:
        raise BadFrame(f"a JPEG of {len(raw)} bytes: {error}") from None
    if image.shape[1::-1] != format.size_px:
        raise BadFrame(f"a JPEG of {image.shape[1]}x{image.shape[0]} px where {format.size_px} px were set")
    return _image(image)


def _row_bytes(layout: Layout, width: int) -> int:
    """Bytes of a row without padding."""
    if layout.packed:
        return -(-width // layout.packed) * (layout.packed + 1)
    if layout.kind in ("rgb", "bgr"):
        return 3 * width
    return 2 * width if layout.kind in ("yuyv", "uyvy") or layout.bits > 8 else width


def _stride(format: PictureFormat, row_bytes: int) -> int:
    """Bytes from row to row; a driver that leaves it 0 means no padding."""
    return format.stride_bytes or row_bytes


def _image(array: object) -> Image:
    return np.asarray(array, dtype=np.uint8)
