"""What people keep by a name on the daemon's disk: places of the head, and targets."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from calib.errors import BadFile
from calib.files.records import read_value
from mastctl.answers import HeadPlace, KeptTarget
from mastctl.errors import BadRequest, NotKnown, Unable
from mastctl.safety.state_folder import StateFile

HOME = "home"
MOST = 50
AT_HOME: HeadPlace = {"pan_rad": 0.0, "tilt_rad": 0.0}
"""Home, until somebody keeps another one."""


class KeptByName:
    """Records by name in one file; safe to use from any thread.

    Each call reads the disk: there are few, and what was kept by hand is seen too.

    Parameters
    ----------
    what
        The records' name, ``places``: of the file, of its schema and of its one key.
    kind
        The TypedDict of a record.
    always
        Records that are there until others of their names are kept.
    """

    def __init__(self, folder: Path, what: str, kind: Any, always: Mapping[str, Any] | None = None) -> None:
        self._file = StateFile(folder / f"{what}.json", f"mastctl/{what}/1")
        self._what, self._kind, self._always = what, dict[str, kind], dict(always or {})
        self._writing = threading.Lock()
        self.known: Mapping[str, Any] = {}
        """The records as they were read last; replaced, never edited."""
        with contextlib.suppress(Unable):
            self._read()

    def all(self) -> dict[str, Any]:
        """Return every record by its name, what is always there first. Raises Unable ``unreadable``."""
        kept = self._read()
        return {name: kept.pop(name, one) for name, one in self._always.items()} | dict(sorted(kept.items()))

    def keep(self, name: str, one: Mapping[str, Any]) -> dict[str, Any]:
        """Keep a record by a name, in the place of a former one, and return all.

        Raises BadRequest ``too_many_places``, ``too_many_targets``; Unable ``unreadable``, ``not_saved``.
        """
        with self._writing:
            kept = self._read()
            if name not in kept and len(kept) >= MOST:
                message = f"{MOST} {self._what} are kept already; forget one of them first"
                raise BadRequest(f"too_many_{self._what}", message)
            self._write({**kept, name: dict(one)})
        return self.all()

    def forget(self, name: str) -> dict[str, Any]:
        """Forget a record and return all that are left.

        Raises NotKnown ``place_unknown``, ``target_unknown``; Unable ``unreadable``, ``not_saved``.
        """
        with self._writing:
            kept = self._read()
            if name not in kept:
                one = self._what.removesuffix("s")
                raise NotKnown(f"{one}_unknown", f"no {one} is kept by the name {name!r}")
            self._write({other: value for other, value in kept.items() if other != name})
        return self.all()

    def _read(self) -> dict[str, Any]:
        try:
            kept = (self._file.read() or {}).get(self._what, {})
            found: dict[str, Any] = read_value(self._kind, kept, self._file.path, self._what)
        except BadFile as error:
            raise Unable("unreadable", str(error)) from None
        self.known = found
        return found

    def _write(self, records: Mapping[str, Any]) -> None:
        try:
            self._file.write({self._what: dict(records)})
        except BadFile as error:
            raise Unable("not_saved", str(error)) from None
        self.known = dict(records)


def places(folder: Path) -> KeptByName:
    """Return the places of the head; home is 0, 0 until it is kept as something else."""
    return KeptByName(folder, "places", HeadPlace, {HOME: AT_HOME})


def targets(folder: Path) -> KeptByName:
    """Return the kept targets."""
    return KeptByName(folder, "targets", KeptTarget)
