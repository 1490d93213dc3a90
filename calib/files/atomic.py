"""Saving a file so that a crash at any moment leaves the old content or the new, never less.

`save_bytes` writes the new content and a copy of the old one beside the file and fsyncs them. It renames the
new one into place, fsyncs the folder, and renames the copy to ``NAME.previous.SUFFIX``. After a crash in
between the folder may hold a hidden ``.NAME.*.new`` or ``.NAME.*.old`` beside the file; neither is ever read.
`replace_bytes` is the same without a copy, for a program's own files. `overwrite_bytes` writes in place, for
callers that cannot wait.
"""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import stat
from itertools import count
from pathlib import Path

from calib.errors import BadFile


def previous_path(path: Path) -> Path:
    """Return where the version before the last save is kept: ``rig.yaml`` -> ``rig.previous.yaml``."""
    return path.with_name(f"{path.stem}.previous{path.suffix}")


def keep_previous(path: str | Path) -> Path | None:
    """Give the kept version before the last save a name that no save takes, and return it.

    ``rig.previous.yaml`` is then ``rig.previous-1.yaml`` too (the first free number). None if there is none.
    Raises BadFile if the file system refuses.
    """
    try:
        previous = previous_path(Path(path).resolve())
        if not previous.is_file():
            return None
        for number in count(1):
            kept = previous.with_name(f"{previous.stem}-{number}{previous.suffix}")
            with contextlib.suppress(FileExistsError):
                _copy(previous, kept)
                return kept
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise BadFile(path, "", f"its former version cannot be kept: {reason or error}") from None
    return None


def save_bytes(path: str | Path, data: bytes) -> None:
    """Replace the file's content in one step; keep its permissions, and the old content as ``previous_path``.

    A symbolic link stays one: the file that it names is replaced. Raises BadFile if the file system refuses;
    the file is then as it was before.
    """
    try:
        target = Path(path).resolve()
        mode = _mode_of(target)
        mark = secrets.token_hex(4)
        new = target.with_name(f".{target.name}.{mark}.new")
        old = target.with_name(f".{target.name}.{mark}.old")
        placed = False
        try:
            write_new(new, data, mode)
            if mode is not None:
                _copy(target, old)
            new.replace(target)
            placed = True
            sync_folder(target.parent)
            if mode is not None:
                old.replace(previous_path(target))
        except OSError:
            with contextlib.suppress(OSError):
                if placed and mode is not None:
                    old.replace(target)
                elif placed:
                    target.unlink()
            for leftover in (new, old):
                with contextlib.suppress(OSError):
                    leftover.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise BadFile(path, "", f"cannot be saved: {error.strerror or error}") from None
    except ValueError as error:  # a path with a NUL
        raise BadFile(path, "", f"cannot be saved: {error}") from None


def replace_bytes(path: Path, data: bytes, mode: int = 0o600) -> None:
    """Replace the file's content in one step; when this returns it is on the disk.

    Leftovers of crashed tries are removed. One process at a time may do this to a file. Raises OSError if the
    file system refuses: the old content is then there, or the new one if only its way to the disk was not
    confirmed.
    """
    new = path.with_name(f".{path.name}.new")
    try:
        new.unlink(missing_ok=True)
        write_new(new, data, mode)
        new.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            new.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def overwrite_bytes(path: Path, data: bytes) -> None:
    """Write over what the file holds, blanks after it; when this returns it is on the disk.

    No name and no length changes, so the file system writes the bytes alone. On ext4 this takes a twentieth
    of the time of `replace_bytes`, and does not wait for other files. A crash meanwhile leaves the old, the
    new, or parts of both. Raises OSError if the file system refuses, there is no file, or it is shorter than
    ``data``.
    """
    descriptor = os.open(path, os.O_WRONLY | os.O_CLOEXEC)
    try:
        size = os.fstat(descriptor).st_size
        if len(data) > size:
            raise OSError(errno.EFBIG, f"has no room for {len(data)} bytes")
        _write_all(descriptor, data.ljust(size))
        os.fdatasync(descriptor)
    finally:
        os.close(descriptor)


def remove(path: Path) -> None:
    """Remove a file; when this returns it is gone from the disk. Raises OSError."""
    path.unlink(missing_ok=True)
    sync_folder(path.parent)


def _mode_of(target: Path) -> int | None:
    """The permissions of the file that is to be replaced; None if there is none yet."""
    try:
        found = target.stat()
    except FileNotFoundError:
        return None
    if not stat.S_ISREG(found.st_mode):
        raise OSError("it is not a regular file")
    return stat.S_IMODE(found.st_mode)


def write_new(new: Path, data: bytes, mode: int | None = None) -> None:
    """Write a file that must not exist; when this returns its content is on the disk. Raises OSError."""
    descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
    try:
        if mode is not None:
            os.fchmod(descriptor, mode)
        _write_all(descriptor, data)
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _write_all(descriptor: int, data: bytes) -> None:
    left = memoryview(data)
    while left:
        left = left[os.write(descriptor, left) :]


def _copy(path: Path, copy: Path) -> None:
    """Write a file's content under a second name, which must be free."""
    write_new(copy, path.read_bytes(), stat.S_IMODE(path.stat().st_mode))


def sync_folder(folder: Path) -> None:
    """Have the names in a folder on the disk. Raises OSError."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
