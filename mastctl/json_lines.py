"""A file of JSON lines that grows: what was appended is on the disk, whole, when that returns."""

from __future__ import annotations

import fcntl
import json
import os
from pathlib import Path

from calib.files import open_plain

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


def read_lines(path: Path, most_bytes: int) -> list[bytes]:
    """Return a file's lines, of the newest so many bytes; none without a file. Raises OSError."""
    try:
        with open_plain(path) as file:
            start = max(0, os.fstat(file.fileno()).st_size - most_bytes)
            file.seek(start)
            return file.read(most_bytes).splitlines()[1 if start else 0 :]
    except FileNotFoundError:
        return []
