"""Pictures from files, decoded by OpenCV without a line of its libraries on stderr."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

PNG_BEGINS = b"\x89PNG\r\n\x1a\n"
JPEG_SCAN = 0xDA
JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
AS_STORED = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
"""Grey, all bits of a sample, and not turned as a camera's tag says."""

# What OpenCV logs goes past Python's handlers; each caller says itself what is wrong.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


def decode_picture(data: bytes, flags: int = AS_STORED) -> NDArray[Any]:
    """Return the pixels of a picture file, (h, w) or (h, w, 3), as cv2.imdecode does with the flags.

    Raises ValueError with the reason as the end of a sentence: it is cut short, damaged, or no picture.
    """
    if (spoiled := spoiled_png(data)) is not None:
        raise ValueError(spoiled)
    is_jpeg = data.startswith(b"\xff\xd8\xff")
    if is_jpeg:
        data = _without_end(data)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except cv2.error:
        image = None
    if image is None:
        raise ValueError("it is cut short or damaged" if is_jpeg else "a PNG or JPEG file is expected")
    return np.asarray(image)


def _without_end(data: bytes) -> bytes:
    """Return a JPEG of one scan without its end marker; empty if it has none, or a part of the scan is lost.

    At that marker libjpeg fills what is missing of a picture with grey, and says so on stderr only; without
    it, it gives up. It looks some bytes ahead. One of several scans is returned as it is.
    """
    segments = dict(jpeg_segments(data))
    at, frame = segments.get(JPEG_SCAN), segments.get(0xC0, segments.get(0xC1))
    if at is None or frame is None or data[at] != data[frame + 5]:
        return data
    end = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]").search(data, at)  # some cameras add a second picture
    scan = b"" if end is None else data[at : end.start()]
    restarts = re.findall(rb"\xff([\xd0-\xd7])", scan)
    in_order = all(one[0] == 0xD0 + number % 8 for number, one in enumerate(restarts))
    return data[:at] + scan + bytes(16) if scan and in_order else b""


def spoiled_png(data: bytes) -> str | None:
    """Return why a PNG file cannot be decoded, None if each of its chunks is whole (or it is no PNG).

    libpng writes about such files to stderr past every Python handler; so it does not get them.
    """
    if not data.startswith(PNG_BEGINS):
        return None
    at = len(PNG_BEGINS)
    while at + 12 <= len(data):
        end = at + 8 + int.from_bytes(data[at : at + 4], "big")
        if end + 4 > len(data):
            break
        if zlib.crc32(data[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            return "a part of it is damaged"
        if data[at + 4 : at + 8] == b"IEND":
            return None
        at = end + 4
    return "it is cut short"


def picture_size_px(data: bytes) -> tuple[int, int] | None:
    """Return (width, height); None where the bytes are no whole picture.

    PNG and JPEG say it in their heads; others, such as TIFF, PGM and BMP, are decoded.
    """
    if data.startswith(PNG_BEGINS) and data[12:16] == b"IHDR" and len(data) >= 24:
        return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    if data.startswith(b"\xff\xd8"):
        for marker, at in jpeg_segments(data):
            if marker in JPEG_FRAMES:  # ISO 10918-1, B.2.2: precision, height, width
                height, width = struct.unpack_from(">HH", data, at + 1)
                return width, height
        return None
    try:
        height, width = decode_picture(data).shape[:2]
    except ValueError:
        return None
    return width, height


def jpeg_segments(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield the marker of each segment of a JPEG up to its first scan, and where what it holds begins.

    ISO 10918-1, B.1.1.
    """
    at = 2
    while at + 10 <= len(data) and data[at] == 0xFF:
        if data[at + 1] == 0xFF:  # fills up
            at += 1
            continue
        yield data[at + 1], at + 4
        if data[at + 1] == JPEG_SCAN:
            return
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
