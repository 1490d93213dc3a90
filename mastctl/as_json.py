"""JSON: records as plain values, and lines that a file grows by, each whole on the disk."""

from __future__ import annotations

import dataclasses
import fcntl
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def as_json(value: Any) -> Any:
    """Return dataclasses, arrays and tuples as plain JSON values; numbers that are not finite become null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: as_json(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {readable(str(key)): as_json(entry) for key, entry in value.items()}
    if type(value).__module__ == "numpy":  # an array or a scalar; NumPy is not loaded for that
        return as_json(value.tolist())
    if isinstance(value, (list, tuple, set, frozenset)):
        return [as_json(entry) for entry in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (int, bool)):
        return value
    return readable(str(value))


def readable(text: str) -> str:
    """Return a text that JSON and every terminal can hold.

    A byte outside UTF-8, which the name of a file may have, is written ``\\udcff``.
    """
    return text if text.isascii() else text.encode("utf-8", "backslashreplace").decode()


TOO_DEEP = "nested too deeply to be shown"


def writable(value: Any) -> Any:
    """Return a value as JSON holds it: itself if it does, else as `as_json` has it."""
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError, RecursionError):
        try:
            return as_json(value)
        except RecursionError:
            return TOO_DEEP
    return value


LONGEST_LINE = 1 << 20


class OtherFile(ValueError):
    """The file does not begin as its lines do."""


def append_line(
    path: Path, line: bytes, most_bytes: int | None = None, begins: bytes = b"", mode: int = 0o666
) -> bool:
    """Append a line with its end; several processes may append to one file. Return whether there was room.

    What a crash has left of a line at the end of the file is taken away first. The file, which is made if it
    is not there, holds up to ``most_bytes`` and starts with ``begins``. Raises OtherFile if it is something
    else (nothing was written then), OSError.
    """
    flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC
    with os.fdopen(os.open(path, flags, mode), "a+b") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # released when the file is closed
        end = _mended(file.fileno(), begins)
        if most_bytes is not None and os.fstat(file.fileno()).st_size + len(end + line) > most_bytes:
            return False
        file.write(end + line)
        file.flush()
        os.fdatasync(file.fileno())
    return True


def _mended(descriptor: int, begins: bytes) -> bytes:
    """Take a torn last line away; return the line end that a whole one lacks."""
    size = os.fstat(descriptor).st_size
    start = max(0, size - LONGEST_LINE)
    tail = os.pread(descriptor, size - start, start)
    last = tail[tail.rfind(b"\n") + 1 :]
    if not begins.startswith(os.pread(descriptor, len(begins), 0)) or len(last) == LONGEST_LINE:
        raise OtherFile(f"the file does not begin with {begins!r}")
    if not last:
        return b""
    try:
        json.loads(last)
    except (ValueError, RecursionError):
        os.ftruncate(descriptor, size - len(last))
        return b""
    return b"\n"
