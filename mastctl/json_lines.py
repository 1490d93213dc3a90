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


def append_line(path: Path, line: bytes, most_bytes: int | None = None, begins: bytes = b"") -> bool:
    """Append a line; several processes may append to one file.

    What a crash has left of a line at the end of the file is taken away first.

    Parameters
    ----------
    path
        Made if it is not there; its folder must be.
    line
        With its end.
    most_bytes
        How long the file may become; None: as long as it may.
    begins
        What the file begins with if it holds such lines.

    Returns
    -------
    bool
        Whether there was room for it.

    Raises
    ------
    OtherFile
        If the file is something else; nothing was written.
    OSError
        If the file system refuses.
    """
    with path.open("a+b") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # released when the file is closed
        end = _mended(file.fileno(), begins)
        if most_bytes is not None and os.fstat(file.fileno()).st_size + len(end + line) > most_bytes:
            return False
        file.write(end + line)
        file.flush()
        os.fsync(file.fileno())
    return True


def mend(descriptor: int) -> int:
    """Leave whole lines only in a file that is open for appending; return its size, bytes. Raises OSError."""
    os.write(descriptor, _mended(descriptor, b""))
    return os.fstat(descriptor).st_size


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
