"""What a run of the tests leaves behind: processes, and things in the temporary folder that is its own.

Each process that runs tests has a folder of its own as ``TMPDIR``, which all that it starts inherits. So what
it left can be told from what others do on the same machine at the same time.
"""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path

from hil_tests.waiting import until

ENDING_S = 10.0  # for processes that were told to end a moment ago
OF_THIS_PROCESS = (b"multiprocessing.resource_tracker", b"multiprocessing.forkserver")
"""Commands of processes that end with the one that runs the tests, when its pipe to them closes."""


class OwnFolder:
    """The temporary folder of one process that runs tests; it goes when that process ends.

    Attributes
    ----------
    path
        Where it is.
    """

    def __init__(self, beside: Path) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="mastctl-tests-", dir=beside))
        self._first_seen: dict[str, str] = {}
        self._ours: set[str] = set()
        self._owner = os.getpid()
        atexit.register(self._remove)

    def keep(self, name: str) -> Path:
        """Return a folder in it that is no test's, and stays to the end."""
        self._ours.add(name)
        (self.path / name).mkdir()
        return self.path / name

    def look(self, test: str) -> None:
        """Remember after which test a thing was there first."""
        for thing in self.path.iterdir():
            self._first_seen.setdefault(thing.name, test)

    def left(self) -> list[str]:
        """Return what is still there, a line each; processes have some seconds to end."""
        with suppress(AssertionError):
            until(lambda: not self._processes(), "no process is left", ENDING_S)
        self.look("the last test")
        things = [
            f"{self.path / name} (first seen after {self._first_seen[name]})"
            for name in sorted({one.name for one in self.path.iterdir()} - self._ours)
        ]
        return things + [f"process {pid}: {words}" for pid, words in sorted(self._processes().items())]

    def _processes(self) -> dict[int, str]:
        """The command lines of living processes that began with this TMPDIR, or that this process began."""
        mark = f"TMPDIR={self.path}".encode()
        found = {}
        for folder in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                command = (folder / "cmdline").read_bytes()  # empty when it has ended and nobody has asked
                parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
                ours = parent == os.getpid() or mark in (folder / "environ").read_bytes().split(b"\0")
                if ours and command and not any(words in command for words in OF_THIS_PROCESS):
                    found[int(folder.name)] = command.replace(b"\0", b" ").decode(errors="replace").strip()
        found.pop(os.getpid(), None)
        servers = [pid for pid, words in found.items() if "hil_tests.forks" in words]  # and its forks
        if servers:
            del found[min(servers)]  # the server lives as long as this process, and came first
        return found

    def _remove(self) -> None:
        if os.getpid() == self._owner:  # not in a fork
            shutil.rmtree(self.path, ignore_errors=True)
