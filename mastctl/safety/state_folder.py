"""The folder in which a daemon keeps its state: where it is, and that no second daemon uses it.

In this order: ``state.folder`` of the configuration; ``$STATE_DIRECTORY`` (systemd); a folder of the
configuration and address under ``$XDG_STATE_HOME`` or ``~/.local/state``. A daemon at any free port, and one
inside another program, keeps its state in a temporary folder that goes with it, if the first two name none.
The latch of a head that others can reach has a place of its own: `mastctl.safety.heads`.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import logging
import os
import shutil
import tempfile
from glob import escape
from pathlib import Path

from calib.errors import BadFile
from mastctl.errors import MastctlError
from mastctl.safety.state_file import StateFile

log = logging.getLogger(__name__)

NAME = "mastctl"
DAEMON_FILE = "daemon.json"
DAEMON_SCHEMA = "mastctl/daemon/1"


class StateInUse(MastctlError):
    """Another daemon keeps its state there."""

    code = "state_in_use"


class StateFolder:
    """A folder that is this daemon's alone until it is closed; `of` and `temporary` make one.

    Attributes
    ----------
    is_temporary
        Whether it goes when it is closed.
    why_temporary
        Why what is kept there is lost with this daemon, though that was not wanted; empty otherwise.
    refused
        Why the disk refused what was to be written at the start; empty if it did not.
    """

    def __init__(
        self, path: Path, *, is_temporary: bool = False, why_temporary: str = "", of_head: str = ""
    ) -> None:
        self.path = path
        self.is_temporary = is_temporary
        self.why_temporary = why_temporary
        self.refused = ""
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
    def temporary(cls, why: str = "") -> StateFolder:
        """Make a folder that goes with the daemon; ``why`` that was not wanted, if so."""
        return cls(Path(tempfile.mkdtemp(prefix="mastctl-state-")), is_temporary=True, why_temporary=why)

    @classmethod
    def of(cls, named: Path | None, config: Path, address: str) -> StateFolder:
        """Take the folder of a configuration, and make it if it is not there.

        A usual place that cannot be made is replaced by a temporary one, since nothing can be kept there; one
        that was ``named`` (``state.folder``) is insisted upon, since something may. The configuration's file
        and the daemon's address make the name of the usual place. Raises BadFile, StateInUse.
        """
        found = cls.named(named)
        if found is not None:
            return found
        try:
            path = usual_folder(config, address)
            _made(path)
        except (BadFile, RuntimeError) as error:  # RuntimeError: this user has no home
            return cls.temporary(str(error))
        return cls(path)

    @classmethod
    def named(cls, named: Path | None) -> StateFolder | None:
        """Take the folder of the configuration or of systemd as `of`; None where neither names one."""
        path = named or _of_systemd()
        if path is None:
            return None
        _made(path)
        return cls(path)

    def note_daemon(self, config: Path, url: str, stop_socket: Path | None) -> None:
        """Write which daemon uses this folder, for commands that find it; `refused` has a disk's refusal."""
        content = {
            "pid": os.getpid(),
            "url": url,
            "config": str(config.resolve()),
            "stop_socket": str(stop_socket),
        }
        try:
            StateFile(self.path / DAEMON_FILE, DAEMON_SCHEMA).write(content)
        except BadFile as error:
            self.refused = str(error)
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


def state_home() -> Path:
    """Return the folder that holds the usual places of all daemons of this user."""
    home = Path(os.environ.get("XDG_STATE_HOME", ""))
    return (home if home.is_absolute() else Path.home() / ".local" / "state") / NAME


def usual_folder(config: Path, address: str) -> Path:
    """Return the usual place of a daemon: the configuration's name, and digits of its path and address."""
    digest = hashlib.sha256(os.fsencode(f"{config.resolve()}\n{address}")).hexdigest()[:8]
    return state_home() / f"{config.stem}-{digest}"


def folder_of(named: Path | None, config: Path, address: str) -> Path | None:
    """Return the folder that `StateFolder.of` takes; None for a user without a home."""
    with contextlib.suppress(RuntimeError):
        return named or _of_systemd() or usual_folder(config, address)
    return None


def folders_of(config: Path | None) -> list[Path]:
    """Return the places in which a daemon's state may be, of one configuration or of any, as far as known.

    Only what is there; for a program that cannot read the configuration.
    """
    found = [path for path in [_of_systemd()] if path is not None and path.is_dir()]
    stem = "*" if config is None else escape(config.stem)
    with contextlib.suppress(OSError, RuntimeError):
        found += sorted(path for path in state_home().glob(f"{stem}-????????") if path.is_dir())
    return found


def _of_systemd() -> Path | None:
    """The folder that systemd made for the unit: the first one, if there are several."""
    first = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    return Path(first) if first else None


def _made(path: Path) -> None:
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise BadFile(path, "", f"the state folder cannot be made: {error.strerror or error}") from None
