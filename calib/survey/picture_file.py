"""What a PNG or JPEG file tells without being decoded: its size, and whether it is whole."""

from __future__ import annotations

import zlib
from pathlib import Path

_PNG = b"\x89PNG\r\n\x1a\n"
_NO_FRAME = {0xC4, 0xC8, 0xCC}


def picture_size_px(path: Path) -> tuple[int, int] | None:
    """Return (width, height) in pixels; None where the file is neither PNG nor JPEG, or is cut short.

    Raises
    ------
    OSError
        If the file cannot be read.
    """
    with path.open("rb") as file:
        head = file.read(1 << 18)
    if head.startswith(_PNG) and head[12:16] == b"IHDR" and len(head) >= 24:
        return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
    return _jpeg_size_px(head) if head.startswith(b"\xff\xd8") else None


def spoiled_png(data: bytes) -> str | None:
    """Return why a PNG file cannot be decoded, None if each of its chunks is whole (or it is no PNG).

    libpng writes about such files to stderr past every Python handler; so it does not get them.
    """
    if not data.startswith(_PNG):
        return None
    at = len(_PNG)
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


def _jpeg_size_px(head: bytes) -> tuple[int, int] | None:
    """Walk the segments to the frame header (ISO 10918-1, B.2.2: SOF, length, precision, height, width)."""
    at = 2
    while at + 9 <= len(head) and head[at] == 0xFF:
        marker = head[at + 1]
        if marker == 0xFF:
            at += 1
        elif 0xC0 <= marker <= 0xCF and marker not in _NO_FRAME:
            height, width = (int.from_bytes(head[i : i + 2], "big") for i in (at + 5, at + 7))
            return width, height
        else:
            at += 2 + int.from_bytes(head[at + 2 : at + 4], "big")
    return None
