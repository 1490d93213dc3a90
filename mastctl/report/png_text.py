"""Text in a PNG: iTXt chunks, so that a picture carries when, where and by which mast file it was taken.

Source: PNG specification, chapters 5 (chunks) and 11.3.3 (text).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_HEADER_END = len(_SIGNATURE) + 4 + 4 + 13 + 4  # IHDR is always first and 13 bytes long


def with_text(png: bytes, texts: Mapping[str, str]) -> bytes:
    """Return a PNG file with texts in it, by keyword (1 to 79 Latin letters).

    Raises ValueError for bytes that are no PNG and for another keyword.
    """
    if png[:8] != _SIGNATURE or png[12:16] != b"IHDR":
        raise ValueError("this is no PNG")
    chunks = b"".join(_chunk(b"iTXt", _international(key, text)) for key, text in texts.items())
    return png[:_HEADER_END] + chunks + png[_HEADER_END:]


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _international(key: str, text: str) -> bytes:
    """The inside of an iTXt chunk: keyword, not compressed, no language, no translation, the text."""
    name = key.encode("latin-1")
    if not 1 <= len(name) <= 79 or b"\0" in name:
        raise ValueError(f"keyword {key!r} has not 1 to 79 letters")
    return name + b"\0\0\0\0\0" + text.encode()
