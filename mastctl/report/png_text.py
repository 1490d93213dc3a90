"""Words in a PNG: iTXt chunks, so that a picture carries when, where and by which mast file it was taken.

Source: PNG specification, chapters 5 (chunks) and 11.3.3 (text).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_HEADER_END = len(_SIGNATURE) + 4 + 4 + 13 + 4  # IHDR is always first and 13 bytes long


def with_text(png: bytes, words: Mapping[str, str]) -> bytes:
    """Return a PNG with words in it, by keyword.

    Parameters
    ----------
    png
        A whole PNG file.
    words
        Keywords (1 to 79 Latin letters) and what they say (any text).

    Raises
    ------
    ValueError
        If ``png`` is none, or a keyword cannot stand in one.
    """
    if png[:8] != _SIGNATURE or png[12:16] != b"IHDR":
        raise ValueError("this is no PNG")
    chunks = b"".join(_chunk(b"iTXt", _international(key, text)) for key, text in words.items())
    return png[:_HEADER_END] + chunks + png[_HEADER_END:]


def read_text(png: bytes) -> dict[str, str]:
    """Return the words that `with_text` put into a PNG. Raises ValueError for broken files."""
    if png[:8] != _SIGNATURE:
        raise ValueError("this is no PNG")
    words, place = {}, len(_SIGNATURE)
    while place + 12 <= len(png):
        (length,) = struct.unpack_from(">I", png, place)
        kind, data = png[place + 4 : place + 8], png[place + 8 : place + 8 + length]
        if kind == b"iTXt":
            key, _, rest = data.partition(b"\0")
            if rest[:2] == b"\0\0":  # not compressed; then language and translated keyword, both empty here
                words[key.decode("latin-1")] = rest[2:].split(b"\0", 2)[2].decode()
        place += 12 + length
    return words


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _international(key: str, text: str) -> bytes:
    """The inside of an iTXt chunk: keyword, not compressed, no language, no translation, the text."""
    name = key.encode("latin-1")
    if not 1 <= len(name) <= 79 or b"\0" in name:
        raise ValueError(f"keyword {key!r} has not 1 to 79 letters")
    return name + b"\0\0\0\0\0" + text.encode()
