"""The folder where the simulator keeps what takes long to make: compiled code and scenes.

``$XDG_CACHE_HOME/mastctl``, by default ``~/.cache/mastctl``. All of it can be made again: it may be deleted
at any time, carried to another machine, or be there for reading only.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Iterable
from pathlib import Path


def kept_folder(kind: str, digest: str) -> Path:
    """Return where a thing of a kind is kept under its digest; it need not be there."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    return home / "mastctl" / kind / digest[:16]


def digest_of(files: Iterable[Path]) -> str:
    """Return one SHA-256 over names and contents of files."""
    digest = hashlib.sha256()
    for file in sorted(files):
        digest.update(file.name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def keep_newest(folder: Path, count: int) -> None:
    """Delete all but the ``count`` things last used beside ``folder``; what cannot be deleted stays."""
    try:
        others = sorted(folder.parent.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True)
    except OSError:  # somebody else is deleting
        return
    for other in others[count:]:
        if other != folder:
            shutil.rmtree(other, ignore_errors=True)
