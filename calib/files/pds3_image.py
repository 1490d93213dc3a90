"""The image of a PDS3 product: where a label points, and samples as the machine has them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.errors import BadFile
from calib.files import read_bytes
from calib.files.odl import LabelBlock, Quantity, integer_in

MAX_FILE_BYTES = 1 << 30

_SAMPLES = {
    **dict.fromkeys(("MSB_INTEGER", "INTEGER", "SUN_INTEGER", "MAC_INTEGER"), ">i"),
    **dict.fromkeys(("MSB_UNSIGNED_INTEGER", "UNSIGNED_INTEGER", "SUN_UNSIGNED_INTEGER"), ">u"),
    **dict.fromkeys(("LSB_INTEGER", "PC_INTEGER", "VAX_INTEGER"), "<i"),
    **dict.fromkeys(("LSB_UNSIGNED_INTEGER", "PC_UNSIGNED_INTEGER", "VAX_UNSIGNED_INTEGER"), "<u"),
    **dict.fromkeys(("IEEE_REAL", "FLOAT", "REAL", "SUN_REAL", "MAC_REAL"), ">f"),
    "PC_REAL": "<f",
}
_BITS = {"i": (8, 16, 32), "u": (8, 16, 32), "f": (32, 64)}


def read_pixels(
    path: Path, root: LabelBlock, block: LabelBlock, data: bytes, size_px: tuple[int, int]
) -> tuple[NDArray[Any] | None, tuple[str, ...]]:
    """Return the pixels that a label points to, and notes.

    Parameters
    ----------
    path, data
        The file that begins with the label, and its bytes.
    root, block
        The label, and its IMAGE object.
    size_px
        (width, height) of the image.

    Returns
    -------
    pixels
        (height, width) in the machine's byte order; None, with a note, if the image's file is not there.
    notes
        Sentences for the user.

    Raises
    ------
    BadFile
        If the samples are of a kind that is not read, the pointer is malformed, or the file is too short.
    """
    width, height = size_px
    code = _SAMPLES.get(str(block.values.get("SAMPLE_TYPE")))
    if code is None:
        found = str(block.values.get("SAMPLE_TYPE", "nothing"))[:40]
        raise BadFile(path, "IMAGE.SAMPLE_TYPE", f"{found} where one of {', '.join(_SAMPLES)} is expected")
    bits = integer_in(block, "SAMPLE_BITS", path, 1, 64)
    if bits not in _BITS[code[1]]:
        raise BadFile(path, "IMAGE.SAMPLE_BITS", f"{bits} where one of {_BITS[code[1]]} is expected")
    if "BANDS" in block.values and integer_in(block, "BANDS", path, 1, 10**6) != 1:
        raise BadFile(path, "IMAGE.BANDS", f"{block.values['BANDS']} where 1 is expected")
    if str(block.values.get("ENCODING_TYPE", "N/A")) not in ("N/A", "NONE"):
        raise BadFile(path, "IMAGE.ENCODING_TYPE", "compressed pixels; plain samples are expected")
    before, after = (
        integer_in(block, key, path, 0, 1 << 20) if key in block.values else 0
        for key in ("LINE_PREFIX_BYTES", "LINE_SUFFIX_BYTES")
    )
    name, offset = _pointer(path, root)
    source = path
    if name:
        beside = _beside(path, name)
        if beside is None:
            return None, (f"{name} is not beside the label; there is no image",)
        source, data = beside, read_bytes(beside, MAX_FILE_BYTES)
    line_bytes = before + width * bits // 8 + after
    if offset + height * line_bytes > len(data):
        raise BadFile(
            source, "IMAGE", f"{len(data)} bytes where at least {offset + height * line_bytes} are expected"
        )
    lines = np.frombuffer(data, np.uint8, height * line_bytes, offset).reshape(height, line_bytes)
    pixels = np.ascontiguousarray(lines[:, before : before + width * bits // 8])
    dtype = np.dtype(f"{code}{bits // 8}")
    return pixels.view(dtype).astype(dtype.newbyteorder("=")), ()


def _pointer(path: Path, root: LabelBlock) -> tuple[str, int]:
    """Return where ^IMAGE points: a file's name ('' for the label's own file) and a byte offset."""
    pointer = root.values.get("^IMAGE")
    items = list(pointer) if isinstance(pointer, tuple) and not isinstance(pointer, Quantity) else [pointer]
    name = str(items.pop(0)) if items and isinstance(items[0], str) else ""
    where = items[0] if items else 1
    if len(items) > 1 or (name and not re.fullmatch(r"[\w.+-]+", name)):
        raise BadFile(path, "^IMAGE", "a record, or a file beside the label with a record, is expected")
    if (
        isinstance(where, Quantity)
        and where.unit.upper() in ("BYTES", "BYTE")
        and isinstance(where.value, int)
    ):
        start, unit_bytes = where.value, 1
    elif isinstance(where, int) and not isinstance(where, Quantity):
        start = where
        unit_bytes = 1 if start == 1 else integer_in(root, "RECORD_BYTES", path, 1, 1 << 24)
    else:
        raise BadFile(path, "^IMAGE", "a record number or a number <BYTES> is expected")
    if not 1 <= start <= 1 << 40:
        raise BadFile(path, "^IMAGE", f"{start} where a record from 1 on is expected")
    return name, (start - 1) * unit_bytes


def _beside(path: Path, name: str) -> Path | None:
    """Return the file of that name beside the label, in whichever case it is written."""
    for candidate in (name, name.lower(), name.upper()):
        if (path.parent / candidate).is_file():
            return path.parent / candidate
    return None
