"""Where a command may write: what is impossible is refused before the minutes of a run, not after them."""

from __future__ import annotations

import tempfile
from pathlib import Path

from mastctl.cli.output import CommandError


def check_file(path: Path, option: str) -> None:
    """Refuse a file that cannot be written, by what is there now."""
    try:
        target = path.resolve()
        if not target.parent.is_dir():
            raise unusable(f"{option} {path}", f"there is no folder {path.parent}; make it first")
        if target.is_dir():
            raise unusable(f"{option} {path}", "is a folder; a file is expected")
        if target.exists() and not target.is_file():
            raise unusable(f"{option} {path}", "is no regular file; a file is expected")
        _try_to_write(target.parent, f"{option} {path}")
    except (OSError, ValueError) as error:
        raise unusable(f"{option} {path}", str(error)) from None


def check_folder(path: Path | None, option: str) -> None:
    """Refuse a folder that cannot be made or written to; None is no folder."""
    if path is None:
        return
    try:
        folder = path.resolve()
        while not folder.exists() and folder != folder.parent:
            folder = folder.parent
        if not folder.is_dir():
            raise unusable(f"{option} {path}", f"{folder} is a file; a folder is expected")
        _try_to_write(folder, f"{option} {path}")
    except (OSError, ValueError) as error:
        raise unusable(f"{option} {path}", str(error)) from None


def _try_to_write(folder: Path, what: str) -> None:
    """Write a nameless file there: permissions alone do not tell (read-only disks, root)."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise unusable(what, f"nothing can be written to {folder}: {error.strerror or error}") from None


def unusable(what: str, why: str) -> CommandError:
    """Return the refusal of a place where a command cannot write."""
    return CommandError("file_system", f"{what}: {why}", exit_code=2)
