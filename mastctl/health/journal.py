"""The pointings of the last days in a file of the state folder: one JSON object a line, bounded in size."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Sequence
from pathlib import Path

from calib.errors import BadFile
from calib.files.atomic import replace_bytes
from mastctl.health.measured import Measured, measured_of

log = logging.getLogger(__name__)

FILE = "pointings.jsonl"
MOST_BYTES = 4 << 20
"""At which the file is written anew with what still counts; some 6000 pointings."""


class Journal:
    """A file of pointings; used by one thread.

    Parameters
    ----------
    path
        The file; its folder must be there.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> list[Measured]:
        """Return what the file holds, in its order; lines that are none are passed over, and told.

        Raises
        ------
        BadFile
            If the file system refuses.
        """
        try:
            with self.path.open("rb") as file:
                start = max(0, os.fstat(file.fileno()).st_size - 2 * MOST_BYTES)
                file.seek(start)
                lines = file.read(2 * MOST_BYTES).splitlines()[1 if start else 0 :]
        except FileNotFoundError:
            return []
        except OSError as error:
            raise BadFile(self.path, "", f"cannot be read: {error.strerror or error}") from None
        found, strange = [], 0
        for line in lines:
            try:
                found.append(measured_of(json.loads(line)))
            except (ValueError, TypeError, RecursionError):
                strange += 1
        if strange:
            log.warning(
                "%s: %d of %d lines are no pointings and do not count", self.path, strange, len(lines)
            )
        return found

    def add(self, one: Measured, counting: Sequence[Measured]) -> None:
        """Append a pointing; where the file is full it is written anew with ``counting``, which has it too.

        What a crash leaves of a line is ended by the next one.

        Raises
        ------
        BadFile
            If the file system refuses; what was there is still there.
        """
        line = _line(one)
        try:
            with self.path.open("ab+") as file:
                size = file.tell()
                if size + len(line) <= MOST_BYTES:
                    torn = size > 0 and os.pread(file.fileno(), 1, size - 1) != b"\n"
                    file.write((b"\n" if torn else b"") + line)
                    file.flush()
                    os.fsync(file.fileno())
                    return
            replace_bytes(self.path, b"".join(map(_line, counting)))
        except OSError as error:
            raise BadFile(self.path, "", f"cannot be written: {error.strerror or error}") from None


def _line(one: Measured) -> bytes:
    return (json.dumps(one.told(), allow_nan=False) + "\n").encode()
