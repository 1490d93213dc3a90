"""What takes long to make and is kept on disk: scenes, and kernels of virtual machines.

``$XDG_CACHE_HOME/mastctl``, by default ``~/.cache/mastctl``. All of it can be made again: it may be deleted
at any time, carried to another machine, or be there for reading only. It does not grow beyond `MOST_BYTES`.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
from collections.abc import Iterable
from pathlib import Path

MOST_BYTES = {"scenes": 400_000_000, "vm": 150_000_000}
"""What is kept of each kind, in bytes; the thing that was made last stays also if it is larger by itself."""


def kept_home() -> Path:
    """Return the folder of all kinds."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "mastctl"


def kept_folder(kind: str, digest: str) -> Path:
    """Return where a thing of a kind is kept under its digest; it need not be there."""
    return kept_home() / kind / digest[:16]


def kept_bytes(kind: str) -> int:
    """Return what is kept of a kind, in bytes."""
    return _size_bytes(kept_home() / kind)


def digest_of(files: Iterable[Path]) -> str:
    """Return one SHA-256 over names and contents of files."""
    digest = hashlib.sha256()
    for file in sorted(files):
        digest.update(file.name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def keep_newest(folder: Path) -> None:
    """Delete what was used longest ago beside ``folder``, until `MOST_BYTES` of its kind are not exceeded.

    ``folder`` stays, and so does what cannot be deleted.
    """
    try:
        others = sorted(folder.parent.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True)
    except OSError:  # another process is deleting
        return
    room = MOST_BYTES[folder.parent.name] - _size_bytes(folder)
    for other in others:
        if other != folder:
            room -= _size_bytes(other)
            if room < 0:
                shutil.rmtree(other, ignore_errors=True)


def _size_bytes(folder: Path) -> int:
    """What the files in a folder take; those that go meanwhile take nothing."""
    size = 0
    for place, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(OSError):
                size += (Path(place) / name).lstat().st_size
    return size
