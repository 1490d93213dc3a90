"""Pictures and plots, as the bytes of a file and as figures of a page.

Plots need matplotlib, an extra of the installation (``report``): `can_plot` before one is begun.
"""

from __future__ import annotations

import base64
import io
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from drivers.interfaces import Image
from mastctl.errors import MastctlError


@dataclass(frozen=True)
class Figure:
    """A picture with its texts.

    ``source`` is what `data_url` returns. ``kind`` is ``photo``; ``lines``, which follow the page into the
    dark; or ``map``, whose colours mean numbers and stay.
    """

    source: str
    alt: str
    caption: str = ""
    kind: str = "photo"


def data_url(content: bytes, kind: str) -> str:
    """Return the bytes of a picture (``png`` or ``jpeg``) as an address that holds them."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


JPEG_QUALITY = 90
PAGE_JPEG_QUALITY = 80
PNG_COMPRESSION = 1  # a noisy picture gains 10 % from more, and takes five times as long
ORANGE_BGR = (0, 140, 255)


def encoded(image: np.ndarray, kind: str, jpeg_quality: int = JPEG_QUALITY) -> bytes:
    """Return a picture as PNG (``png``, lossless) or JPEG (``jpeg``)."""
    options = (
        [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION]
        if kind == "png"
        else [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality]
    )
    done, data = cv2.imencode(f".{kind}", image, options)
    if not done:
        raise MastctlError(f"the picture cannot be written as {kind}")
    return bytes(data)


def photo(image: np.ndarray, alt: str, caption: str) -> Figure:
    """Return a picture as a figure of a page."""
    return Figure(data_url(encoded(image, "jpeg", PAGE_JPEG_QUALITY), "jpeg"), alt, caption)


def in_colour(image: Image) -> Image:
    """Return a copy (h, w, 3), BGR, to draw on."""
    return np.asarray(
        cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image.copy(), dtype=np.uint8
    )


def enlarged(image: Image, center_px: tuple[float, float], half_px: int, scale: int) -> Image:
    """Return the surroundings of a pixel, ``half_px`` to each side, in colour; black beyond the image's edge.

    The pixel comes to ``(half_px * scale, half_px * scale)``.
    """
    matrix = np.array(
        [[scale, 0.0, scale * (half_px - center_px[0])], [0.0, scale, scale * (half_px - center_px[1])]]
    )
    side = 2 * half_px * scale + 1
    piece = cv2.warpAffine(in_colour(image), matrix, (side, side), flags=cv2.INTER_LINEAR)
    return np.asarray(piece, dtype=np.uint8)


def with_text(png: bytes, texts: Mapping[str, str]) -> bytes:
    """Return a PNG file with texts by keyword (1 to 79 Latin letters): iTXt chunks after the header.

    Source: PNG specification, chapters 5 (chunks) and 11.3.3 (text); the header IHDR ends at byte 33.
    """

    def chunk(data: bytes) -> bytes:
        checked = b"iTXt" + data
        return struct.pack(">I", len(data)) + checked + struct.pack(">I", zlib.crc32(checked))

    chunks = (chunk(key.encode("latin-1") + b"\0\0\0\0\0" + text.encode()) for key, text in texts.items())
    return png[:33] + b"".join(chunks) + png[33:]


BLUE, RUST, GREEN, VIOLET, AMBER, GREY = "#1f6f8b", "#c1440e", "#2d7d46", "#7a4b9d", "#b26a00", "#555555"
COLOURS = (BLUE, RUST, GREEN, VIOLET, AMBER, GREY)
DPI = 110


def can_plot() -> bool:
    """Return whether matplotlib is installed."""
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        return False
    return True


def new_plot(width_inch: float, height_inch: float) -> Any:
    """Return an empty matplotlib figure, which no screen and no global state knows of."""
    from matplotlib import figure

    return figure.Figure(figsize=(width_inch, height_inch), layout="constrained")


def plot(figure: Any, alt: str, caption: str = "", kind: str = "lines") -> Figure:
    """Return a plot as a figure of a page; ``kind`` as `Figure` has it."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return Figure(data_url(buffer.getvalue(), "png"), alt, caption, kind)
