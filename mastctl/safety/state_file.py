"""Files in which a daemon keeps what must outlive it: one JSON document each, versioned, replaced whole.

`StateFile.overwrite` is for the one document that has no time for that, and that counts as written where the
file cannot be read.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calib.errors import BadFile
from calib.files import open_plain
from calib.files.atomic import overwrite_bytes, remove, replace_bytes

MAX_BYTES = 1 << 20


@dataclass(frozen=True)
class StateFile:
    """One document, of which a crash during `write` leaves the old or the new, whole.

    ``path`` is in a folder that is there; ``schema`` its kind and version, such as ``mastctl/latch/1``: a
    file with another one is refused. ``room`` is how long the file is at least, bytes, filled up with blanks:
    what `overwrite` may need.
    """

    path: Path
    schema: str
    room: int = 0
    mode: int = 0o600

    def read(self) -> dict[str, Any] | None:
        """Return the document without its schema; None if there is no file.

        Raises BadFile if there is one that cannot be read, or is something else.
        """
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
            raise BadFile(
                self.path, "", f"is no JSON (its {len(data)} bytes are not what was written)"
            ) from None
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
        data = self._data(document)
        try:
            replace_bytes(self.path, data.ljust(self.room), self.mode)
        except OSError as error:
            raise BadFile(self.path, "", f"cannot be saved: {error.strerror or error}") from None

    def overwrite(self, document: Mapping[str, Any]) -> None:
        """Write a document over the former one, as quickly as can be; when this returns it is on the disk.

        A crash meanwhile may leave a file that cannot be read: only for what then counts as this document.
        Raises as `write`, and BadFile if there is no file with room for it.
        """
        data = self._data(document)
        try:
            overwrite_bytes(self.path, data)
        except OSError as error:
            raise BadFile(self.path, "", f"cannot be overwritten: {error.strerror or error}") from None

    @property
    def has_room(self) -> bool:
        """Whether a file is there that can be written over."""
        try:
            return self.path.stat().st_size >= self.room
        except OSError:
            return False

    def _data(self, document: Mapping[str, Any]) -> bytes:
        text = json.dumps({"schema": self.schema, **document}, indent=1, allow_nan=False)
        return f"{text}\n".encode()

    def remove(self) -> None:
        """Take the file away; when this returns it is gone from the disk too. Raises BadFile."""
        try:
            remove(self.path)
        except OSError as error:
            raise BadFile(self.path, "", f"cannot be removed: {error.strerror or error}") from None
