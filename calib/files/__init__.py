"""Reading and writing files: what every format shares.

Every reader refuses with `calib.errors.BadFile` and nothing else. A save leaves the old content or the new
after a crash at any moment, never less: `save_bytes` writes the new content and a copy of the old one beside
the file and fsyncs them. It renames the new one into place, fsyncs the folder, and renames the copy to
``NAME.previous.SUFFIX``. After a crash in between the folder may hold a hidden ``.NAME.*.new`` or
``.NAME.*.old`` beside the file; neither is ever read. `replace_bytes` is the same without a copy, for a
program's own files. `overwrite_bytes` writes in place, for callers that cannot wait.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import secrets
import stat
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike

from calib.errors import BadFile
from calib.geometry.cahvor import CameraModel, Kind
from calib.geometry.rigid import unit_vector

UNKNOWN_FRAME = "unknown"
LARGEST_IMAGE_PX = 65536


@dataclass(frozen=True, eq=False)
class CameraFile:
    """One camera as a file holds it.

    ``frame`` names the frame of the model's vectors, ``unknown`` where the format has no place for it.
    ``fit`` and ``provenance`` are carried through unread; a covariance in ``fit`` names its parameter order.
    ``notes`` are sentences for the user: what was changed on reading, what was not read. ``path`` is None for
    one made in the program.
    """

    model: CameraModel
    frame: str
    fit: Mapping[str, Any] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    path: Path | None = None

    def __post_init__(self) -> None:
        for name in ("fit", "provenance"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))


def read_bytes(path: str | Path, limit_bytes: int) -> bytes:
    """Return the whole file, or raise BadFile if it cannot be read, is empty, or is larger than the limit."""
    try:
        with open_plain(path) as file:
            data = file.read(limit_bytes + 1)
    except (OSError, ValueError) as error:  # a path with a NUL is a ValueError
        raise BadFile(path, "", f"cannot be read: {_reason(error)}") from None
    if len(data) > limit_bytes:
        raise BadFile(path, "", f"is larger than {limit_bytes} bytes, the most that is read")
    if not data:
        raise BadFile(path, "", "is empty")
    return data


def open_plain(path: str | Path) -> BinaryIO:
    """Open a file to be read; waits for nothing. Raises OSError, also for a pipe, a socket or a device."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        raise OSError(errno.EINVAL, "it is a pipe or a device; a plain file is expected")
    return os.fdopen(descriptor, "rb")


def text_of(data: bytes, path: str | Path) -> str:
    """Return the text of a file's bytes, UTF-8 with or without a byte-order mark. Raises BadFile."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise BadFile(path, f"line {line}", f"byte 0x{data[error.start]:02x} is not UTF-8 text") from None


def is_plain_file(path: Path) -> bool:
    """Return whether there is a file, or a link to one: no folder, pipe or device, and a name that exists."""
    try:
        return path.is_file()
    except OSError:  # of a name that no disk takes
        return False


def digest_of(data: bytes) -> str:
    """Return the SHA-256 of the bytes, in hexadecimal: the name of a file's content."""
    return hashlib.sha256(data).hexdigest()


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
        if previous.is_file():
            for number in count(1):
                kept = previous.with_name(f"{previous.stem}-{number}{previous.suffix}")
                with contextlib.suppress(FileExistsError):
                    _copy(previous, kept)
                    return kept
    except (OSError, ValueError) as error:
        raise BadFile(path, "", f"its former version cannot be kept: {_reason(error)}") from None
    return None


def save_bytes(path: str | Path, data: bytes) -> None:
    """Replace the file's content in one step; keep its permissions, and the old content as ``previous_path``.

    A symbolic link stays one: the file that it names is replaced. Raises BadFile if the file system refuses;
    the file is then as it was before.
    """
    try:
        target = Path(path).resolve()
        was_there = target.exists()
        if was_there and not target.is_file():
            raise OSError("it is not a regular file")
        mark = secrets.token_hex(4)
        new, old = (target.with_name(f".{target.name}.{mark}.{end}") for end in ("new", "old"))
        with contextlib.ExitStack() as undo:
            undo.callback(new.unlink, missing_ok=True)
            undo.callback(old.unlink, missing_ok=True)
            write_new(new, data, _mode_of(target) if was_there else None)
            if was_there:
                _copy(target, old)
            new.replace(target)
            if was_there:
                undo.callback(old.replace, target)
            else:
                undo.callback(target.unlink)
            sync_folder(target.parent)
            if was_there:
                old.replace(previous_path(target))
            undo.pop_all()
    except (OSError, ValueError) as error:  # a path with a NUL is a ValueError
        raise BadFile(path, "", f"cannot be saved: {_reason(error)}") from None


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


def _mode_of(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def _copy(path: Path, copy: Path) -> None:
    """Write a file's content under a second name, which must be free."""
    write_new(copy, path.read_bytes(), _mode_of(path))


def sync_folder(folder: Path) -> None:
    """Have the names in a folder on the disk. Raises OSError."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _reason(error: OSError | ValueError) -> str:
    return str(getattr(error, "strerror", None) or error)


def build_model(
    path: str | Path,
    place: str,
    kind: Kind,
    size_px: tuple[int, int],
    vectors: Mapping[str, ArrayLike],
    cahvore_type: int = 0,
    linearity: float | None = None,
) -> tuple[CameraModel, tuple[str, ...]]:
    """Return the camera model of numbers read from a file, A and O normalised, with the notes to report.

    ``path`` and ``place`` are for messages. ``vectors`` are C, A, H, V and, as the kind needs, O, R, E, each
    (3,); ``linearity`` is None where the type fixes it. Raises BadFile if the numbers are no camera: not
    finite, beyond 1e9, A or O zero, A H V in one plane.
    """

    def at(letter: str) -> str:
        return f"{place}.{letter}" if place else letter

    arrays = {letter: np.asarray(vector, dtype=np.float64) for letter, vector in vectors.items()}
    for letter, array in arrays.items():
        if not (np.abs(array) <= 1e9).all():  # beyond, the arithmetic would overflow
            raise BadFile(path, at(letter), f"{array.tolist()} where finite numbers up to 1e9 are expected")
    for letter in "AO":
        if letter in arrays and np.linalg.norm(arrays[letter]) < 1e-6:
            raise BadFile(path, at(letter), f"{arrays[letter].tolist()} where a unit vector is expected")
    if not 0 < min(size_px) <= max(size_px) <= LARGEST_IMAGE_PX:
        raise BadFile(
            path, at("size_px"), f"{list(size_px)} where 1 to {LARGEST_IMAGE_PX} pixels are expected"
        )

    notes = []
    where = f"{place}: " if place else ""
    fixed = {1: 1.0, 2: 0.0}.get(cahvore_type)
    if fixed is not None:
        if linearity is not None and linearity != fixed:
            notes.append(f"{where}linearity {linearity:g} is not used; type {cahvore_type} means {fixed:g}")
        linearity = fixed
    try:
        with np.errstate(all="ignore"):
            units = {letter: unit_vector(arrays[letter]) for letter in "AO" if letter in arrays}
            model = CameraModel(
                kind,
                size_px,
                cahvore_type=cahvore_type,
                linearity=1.0 if linearity is None else linearity,
                **arrays | units,
            )
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        raise BadFile(path, place, f"is no usable camera model: {error}") from None
    lengths = {letter: float(np.linalg.norm(arrays[letter])) for letter in units}
    off = max(abs(length - 1.0) for length in lengths.values())
    # Labels print six digits; a hundred-thousandth is 0.01 px at x = 1000.
    if off > 1e-5:
        sizes = " and ".join(f"|{letter}| = {length:.6g}" for letter, length in lengths.items())
        notes.append(f"{where}{sizes} made 1, which moves pixels by about {100 * off:.2g} %")
    return model, tuple(notes)


def blind_part(model: CameraModel) -> float:
    """Return the part of the image, to its outer border, that has no ray."""
    x, y = (np.linspace(-0.5, size - 0.5, count) for size, count in zip(model.size_px, (38, 31), strict=True))
    return float(1.0 - model.ray(np.stack(np.meshgrid(x, y), axis=-1)).valid.mean())


def blind_notes(model: CameraModel, path: str | Path, place: str) -> tuple[str, ...]:
    """Return a note of the part of the image that has no ray, and why; none if every pixel has one.

    Raises BadFile if more than half of the image has no ray, or the lens folds at its axis.
    """
    try:
        blind = blind_part(model)
    except ValueError as problem:
        raise BadFile(path, place, f"is no usable camera: {problem}") from None
    why = model.limit_reason or "the lens looks sideways"
    if blind > 0.5:  # a fisheye's corners often have none
        raise BadFile(path, place, f"{100 * blind:.0f} %, more than half of the image has no ray: {why}")
    where = f"{place}: " if place else ""
    return (f"{where}{100 * blind:.2g} % of the image has no ray: {why}",) if blind else ()
