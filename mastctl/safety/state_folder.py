"""Folders in which a daemon keeps what must outlive it, each for one program at a time; and their files.

The state folder is, in this order: ``state.folder`` of the configuration; ``$STATE_DIRECTORY`` (systemd); a
folder of the configuration and address under ``$XDG_STATE_HOME`` or ``~/.local/state``. A daemon at any free
port, and one inside another program, keeps its state in a temporary folder that goes with it, if the first
two name none.

The latch of a head that others can reach has a folder of its own, by what the head is, not by the program
that drives it. A head has a name (`drivers.hardware.head_name`); the folder of that name is in
``/var/lib/mastctl/heads``, where ``/var/lib/mastctl`` exists (the systemd unit makes it) and this user may
write; else in ``.local/state/mastctl/heads`` of the user's home as the password database has it. No variable
of the environment moves it. Only a simulator's line (a pseudo terminal, loopback) and a driver from outside
without a ``port`` follow ``$MASTCTL_HEADS``, so that tests share nothing.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import logging
import os
import pwd
import re
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from glob import escape
from pathlib import Path
from typing import Any

from calib.errors import BadFile
from mastctl.errors import MastctlError

log = logging.getLogger(__name__)

NAME = "mastctl"
DAEMON_FILE = "daemon.json"
DAEMON_SCHEMA = "mastctl/daemon/1"
MAX_BYTES = 1 << 20
SYSTEM = Path("/var/lib/mastctl")
VARIABLE = "MASTCTL_HEADS"
READABLE = 0o755  # another user who opens the same line has to find the latch
_SIMULATED = re.compile(r"pts-|127\.|\[?::1\]?(?::|$)|[\w.:-]+ \{")
_PTS = re.compile(r"pts-\d+-")


class StateInUse(MastctlError):
    """Another daemon keeps its state there."""

    code = "state_in_use"


@dataclass(frozen=True)
class StateFile:
    """One JSON document, of which a crash during `write` leaves the old or the new, whole.

    ``schema`` is its kind and version; a file with another one is refused. ``room`` is how long the file is
    at least, bytes, filled up with blanks: what `overwrite` may need.
    """

    path: Path
    schema: str
    room: int = 0
    mode: int = 0o600

    def read(self) -> dict[str, Any] | None:
        """Return the document without its schema; None without a file.

        Raises BadFile if the file cannot be read, or is something else.
        """
        from calib.files import open_plain  # loads NumPy, which a stop from another process has no time for

        try:
            with open_plain(self.path) as file:
                data = file.read(MAX_BYTES + 1)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise BadFile(self.path, "", f"cannot be read: {error.strerror or error}") from None
        if len(data) > MAX_BYTES:
            raise BadFile(self.path, "", f"is larger than {MAX_BYTES} bytes")
        try:
            document = json.loads(data)
        except (ValueError, RecursionError):
            message = f"is no JSON (its {len(data)} bytes are not what was written)"
            raise BadFile(self.path, "", message) from None
        if not isinstance(document, dict):
            raise BadFile(self.path, "", f"holds no JSON object where one of {self.schema} is expected")
        found = document.pop("schema", None)
        if found != self.schema:
            raise BadFile(self.path, "schema", f"{found!r} where '{self.schema}' is expected")
        return document

    def write(self, document: Mapping[str, Any]) -> None:
        """Put a document in the place of the former one; when this returns it is on the disk.

        Raises BadFile if the file system refuses; what is then read is the former document, or the new one if
        only its way to the disk was not confirmed.
        """
        from calib.files import replace_bytes

        try:
            replace_bytes(self.path, self._data(document).ljust(self.room), self.mode)
        except OSError as error:
            raise BadFile(self.path, "", f"cannot be saved: {error.strerror or error}") from None

    def overwrite(self, document: Mapping[str, Any]) -> None:
        """Write a document over the former one, quickly; when this returns it is on the disk.

        A crash meanwhile may leave a file that cannot be read: only for what then counts as this document.
        Where no file has room for it, it is written anew. Raises as `write`.
        """
        from calib.files import overwrite_bytes

        try:
            overwrite_bytes(self.path, self._data(document))
        except OSError:
            self.write(document)

    def _data(self, document: Mapping[str, Any]) -> bytes:
        text = json.dumps({"schema": self.schema, **document}, indent=1, allow_nan=False)
        return f"{text}\n".encode()


class StateFolder:
    """A folder that is this program's alone until it is closed; `of`, `temporary` and `take_head` make one.

    ``is_temporary``: it goes when it is closed.
    """

    def __init__(self, path: Path, *, is_temporary: bool = False, of_head: str = "") -> None:
        self.path = path
        self.is_temporary = is_temporary
        try:
            self._lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except OSError as error:
            raise BadFile(path, "", f"cannot be the state folder: {error.strerror or error}") from None
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._lock)
            message = (
                f"the head at {of_head} is driven by another program (its place {path} is in use); end that"
                if of_head
                else f"the state folder {path} is in use by another daemon; end it, or give this one another "
                "folder (key state.folder)"
            )
            raise StateInUse(message) from None

    @classmethod
    def temporary(cls) -> StateFolder:
        """Make a folder that goes with the daemon."""
        return cls(Path(tempfile.mkdtemp(prefix="mastctl-state-")), is_temporary=True)

    @classmethod
    def of(cls, named: Path | None, config: Path, address: str | None) -> StateFolder:
        """Take the folder of a configuration and an address, and make it if it does not exist.

        ``address`` is None for one that does not come again: without a ``named`` folder (``state.folder``, or
        that of systemd) it is temporary. Raises BadFile, StateInUse.
        """
        if address is None and not named and not _of_systemd():
            return cls.temporary()
        path = folder_of(named, config, address or "")
        if path is None:
            message = "this user has no home for the state folder; name a folder that can be made"
            raise BadFile(config, "state.folder", message)
        try:
            path.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError as error:
            message = (
                f"cannot be made: {error.strerror or error}; name another state folder (key state.folder)"
            )
            raise BadFile(path, "", message) from None
        return cls(path)

    def note_daemon(self, config: Path, url: str, stop_socket: Path | None) -> None:
        """Write which daemon uses this folder, for commands that find it."""
        content = {"pid": os.getpid(), "url": url, "config": str(config.resolve())}
        try:
            note = StateFile(self.path / DAEMON_FILE, DAEMON_SCHEMA)
            note.write({**content, "stop_socket": str(stop_socket)})
        except BadFile as error:
            log.error("the state folder cannot be written: %s", error)

    def close(self) -> None:
        """Let another daemon have it; does nothing the second time."""
        lock, self._lock = self._lock, -1
        if lock < 0:
            return
        if self.is_temporary:
            gone = self.path.with_name(f"{self.path.name}-gone")
            with contextlib.suppress(OSError):
                self.path.rename(gone)  # what still writes finds no folder: a file more would keep it
            shutil.rmtree(gone, ignore_errors=True)
        with contextlib.suppress(OSError):
            os.close(lock)


def usual_folder(config: Path, address: str) -> Path:
    """Return the usual place of a daemon: the configuration's name, and digits of its path and address.

    Raises RuntimeError for a user without a home.
    """
    digits = _digits(os.fsencode(f"{config.resolve()}\n{address}"))
    return _state_home() / f"{config.stem}-{digits}"


def folder_of(named: Path | None, config: Path, address: str) -> Path | None:
    """Return the folder that `StateFolder.of` takes; None for a user without a home."""
    with contextlib.suppress(RuntimeError):
        return named or _of_systemd() or usual_folder(config, address)
    return None


def folders_of(config: Path | None) -> list[Path]:
    """Return the folders in which a daemon's state may be, of one configuration or of any, as far as known.

    Those of all heads too; for a program that cannot, or need not, read the configuration.
    """
    found = [path for path in [_of_systemd()] if path is not None]
    stem = "*" if config is None else escape(config.stem)
    with contextlib.suppress(OSError, RuntimeError):
        found += sorted(_state_home().glob(f"{stem}-????????"))
    for parent in _heads_parents():
        with contextlib.suppress(OSError):
            found += sorted(parent.iterdir())
    return found


def head_folders(name: str | None) -> list[Path]:
    """Return the folders in which a head's latch may lie, the one that is preferred first.

    None for a head without a name.
    """
    if name is None:
        return []
    folder = f"{re.sub(r'[^A-Za-z0-9._-]', '_', name)[:80]}-{_digits(name.encode())}"
    given = os.environ.get(VARIABLE, "")
    if given and _SIMULATED.match(name):
        return [Path(given) / folder]
    return [parent / folder for parent in _heads_parents()]


def take_head(name: str) -> StateFolder | None:
    """Take a head's folder for this program alone; None where none can be made.

    Raises StateInUse if another program drives this head.
    """
    refused = ""
    for folder in head_folders(name):
        try:
            for path in (folder.parent, folder):
                with contextlib.suppress(FileExistsError):
                    path.mkdir(parents=True)
                    path.chmod(READABLE)  # whatever the umask
        except OSError as error:
            refused = refused or f"{folder}: {error.strerror or error}"
            continue
        if os.access(folder, os.W_OK):
            if found := _PTS.match(name):  # of pseudo terminals that had this number before: closed for good
                for other in folder.parent.glob(f"{found.group()}*"):
                    if other != folder:
                        shutil.rmtree(other, ignore_errors=True)
            return StateFolder(folder, of_head=name)
    log.warning("the latch of the head at %s stays in the state folder alone: %s", name, refused)
    return None


def _heads_parents() -> list[Path]:
    found = [SYSTEM / "heads"] if SYSTEM.is_dir() else []
    with contextlib.suppress(KeyError):  # a user whom the password database does not know
        found.append(_home() / ".local" / "state" / NAME / "heads")
    return found


def _state_home() -> Path:
    """The folder of the usual places of all daemons of this user. Raises RuntimeError without a home."""
    home = Path(os.environ.get("XDG_STATE_HOME", ""))
    return (home if home.is_absolute() else Path.home() / ".local" / "state") / NAME


def _home() -> Path:
    """This user's home, whatever ``$HOME`` says. Raises KeyError."""
    return Path(pwd.getpwuid(os.getuid()).pw_dir)


def _digits(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:8]


def _of_systemd() -> Path | None:
    """The folder that systemd made for the unit: the first one, if there are several."""
    first = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    return Path(first) if first else None
