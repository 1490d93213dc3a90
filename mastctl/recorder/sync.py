"""What is written to a file put on the disk, by a thread that alone waits for it."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

FINISH_S = 3.0


class Sync:
    """Has a file's bytes on the disk soon after each `ask`; nobody else waits for the disk.

    Parameters
    ----------
    descriptor
        Of the file; closed by `finish`.
    folder
        Where the file was just made: its name is put on the disk first.
    """

    def __init__(self, descriptor: int, folder: Path) -> None:
        self._descriptor = descriptor
        self._folder = folder
        self._asked = threading.Event()
        self._last = False
        self._since_s: float | None = None
        self._error: OSError | None = None
        self._thread = threading.Thread(target=self._work, name="recorder sync", daemon=True)
        self._thread.start()

    @property
    def waits_s(self) -> float:
        """How long the disk has not answered, seconds; 0 while nothing is asked of it."""
        since_s = self._since_s
        return 0.0 if since_s is None else time.monotonic() - since_s

    def ask(self) -> None:
        """Have all that was written so far put on the disk. Raises OSError if that failed before."""
        if self._error is not None:
            raise self._error
        self._asked.set()

    def finish(self, *, wait: bool) -> None:
        """Put the rest on the disk and close the file; wait for it, some seconds at most, or not.

        Raises
        ------
        OSError
            If it failed, and that is known.
        """
        self._last = True
        self._asked.set()
        if wait:
            self._thread.join(FINISH_S)
        if self._error is not None:
            raise self._error

    def _work(self) -> None:
        try:
            self._sync_folder()
            while not self._last:
                self._asked.wait()
                self._asked.clear()
                self._sync()
            self._sync()
        finally:
            os.close(self._descriptor)

    def _sync(self) -> None:
        self._since_s = time.monotonic()
        try:
            os.fdatasync(self._descriptor)
        except OSError as error:
            self._error = error
        finally:
            self._since_s = None

    def _sync_folder(self) -> None:
        try:
            folder = os.open(self._folder, os.O_RDONLY | os.O_DIRECTORY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
        except OSError as error:
            self._error = error
