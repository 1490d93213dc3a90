"""The folder of a head's latch: by what the head is, not by the program that drives it.

A head has a name (`drivers.hardware.head_name`), and its place is a folder of that name in
``/var/lib/mastctl/heads``, where ``/var/lib/mastctl`` is there (the systemd unit makes it) and this user may
write; else in ``.local/state/mastctl/heads`` of the user's home as the password database has it. No variable
of the environment moves it. Only a simulator's line (a pseudo terminal, loopback) and a driver from outside
without a ``port`` follow ``$MASTCTL_HEADS``, so that tests share nothing.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import pwd
import re
import shutil
from collections.abc import Sequence
from pathlib import Path

from drivers.hardware import HardwareSettings, head_name
from mastctl.safety.state_folder import StateFolder

log = logging.getLogger(__name__)

SYSTEM = Path("/var/lib/mastctl")
VARIABLE = "MASTCTL_HEADS"
READABLE = 0o755  # another user who opens the same line has to find the latch
_SIMULATED = re.compile(r"pts-|127\.|\[?::1\]?(?::|$)|[\w.:-]+ \{")
_PTS = re.compile(r"pts-\d+-")


def head_folders(name: str) -> list[Path]:
    """Return the folders in which a head's latch may lie, the one that is preferred first."""
    given = os.environ.get(VARIABLE, "")
    if given and _SIMULATED.match(name):
        return [Path(given) / _folder_name(name)]
    found = [SYSTEM / "heads"] if _is_there(SYSTEM) else []
    with contextlib.suppress(KeyError):  # a user whom the password database does not know
        found.append(_home() / ".local" / "state" / "mastctl" / "heads")
    return [folder / _folder_name(name) for folder in found]


def take(name: str) -> StateFolder | None:
    """Take a head's place for this program alone; None where none can be made.

    Raises StateInUse if another program drives this head.
    """
    refused = ""
    for folder in head_folders(name):
        try:
            _make(folder)
        except OSError as error:
            refused = refused or f"{folder}: {error.strerror or error}"
            continue
        if os.access(folder, os.W_OK):
            _clear_beside(folder)
            return StateFolder(folder, of_head=name)
    log.warning("the latch of the head at %s stays in the state folder alone: %s", name, refused)
    return None


def of_settings(settings: HardwareSettings) -> StateFolder | None:
    """Take the place of a configuration's head as `take`; None for one in this program's memory."""
    name = head_name(settings)
    return None if name is None else take(name)


def others(name: str | None, place: StateFolder | None) -> Sequence[Path]:
    """Return the head's folders beside the one that was taken: what is latched there counts too."""
    if name is None:
        return ()
    return [folder for folder in head_folders(name) if place is None or folder != place.path]


def _make(folder: Path) -> None:
    """Make the folder and the one that holds all heads. Raises OSError."""
    for path in (folder.parent, folder):
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            continue
        path.chmod(READABLE)  # whatever the umask


def _clear_beside(folder: Path) -> None:
    """Remove the places of pseudo terminals that had this one's number before: they are closed for good."""
    found = _PTS.match(folder.name)
    if found is not None:
        for other in folder.parent.glob(f"{found.group()}*"):
            if other != folder:
                shutil.rmtree(other, ignore_errors=True)


def _folder_name(name: str) -> str:
    digits = hashlib.sha256(name.encode()).hexdigest()[:8]
    return f"{re.sub(r'[^A-Za-z0-9._-]', '_', name)[:80]}-{digits}"


def _home() -> Path:
    """This user's home, whatever ``$HOME`` says. Raises KeyError."""
    return Path(pwd.getpwuid(os.getuid()).pw_dir)


def _is_there(folder: Path) -> bool:
    try:
        return folder.is_dir()
    except OSError:  # what cannot be looked into may hold a latch
        return True
