"""What tests leave behind: threads, descriptors, processes, temporary files, and daemons' state at home.

Each process that runs tests has a folder of its own as ``TMPDIR``, which all that it starts inherits. So what
it left can be told from what others do on the same machine at the same time. The home in which daemons keep
the places of their heads is in that folder too.
"""

from __future__ import annotations

import atexit
import os
import pwd
import shutil
import signal
import tempfile
import threading
from contextlib import suppress
from pathlib import Path

from hil_tests.waiting import until

ENDING_S = 10.0  # for processes that were told to end a moment ago
OF_THIS_PROCESS = (b"multiprocessing.resource_tracker", b"multiprocessing.forkserver")
"""Commands of processes that end with the one that runs the tests, when its pipe to them closes."""


RUN_OF_WORKERS = "PYTEST_XDIST_TESTRUNUID"
"""xdist's name of a run, in the environment of each worker and of what that started."""


def end_all_of(run: str, beside: Path) -> None:
    """End what workers of a run of xdist have started, and remove their folders.

    A run that is interrupted ends them in the middle of a test, which then cannot end its daemons.
    """
    mark = f"{RUN_OF_WORKERS}={run}".encode()
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if mark in (folder / "environ").read_bytes().split(b"\0"):
                os.kill(int(folder.name), signal.SIGKILL)
    for folder in beside.glob(f"mastctl-tests-{run[:8]}*"):
        shutil.rmtree(folder, ignore_errors=True)


def held() -> set[object]:
    """Running threads of this process, and its open descriptors, each with what it is open on.

    What a test leaves is what is new: ``held() <= before``. Two counts tell nothing, since what earlier tests
    of the same process made hang may end at any moment.
    """
    found: set[object] = set(threading.enumerate())
    for link in list(Path("/proc/self/fd").iterdir()):
        with suppress(FileNotFoundError):  # the descriptor of this very look
            found.add((link.name, link.readlink()))
    return found


def live_in(home: Path) -> None:
    """Have the password database name a home for this process and its forks.

    The place of a head at a true line is in that home whatever a test's environment says. In the user's own
    one it could not be known which of the programs that run at the same time has made it.
    """
    entry_of = pwd.getpwuid

    def getpwuid(user: int, /) -> pwd.struct_passwd:
        found = entry_of(user)
        return found if user != os.getuid() else pwd.struct_passwd((*found[:5], str(home), found.pw_shell))

    pwd.getpwuid = getpwuid


class OwnFolder:
    """The temporary folder of one process that runs tests; it goes when that process ends.

    Attributes
    ----------
    path
        Where it is.
    """

    def __init__(self, beside: Path) -> None:
        run = os.environ.get(RUN_OF_WORKERS, "")[:8]
        self.path = Path(tempfile.mkdtemp(prefix=f"mastctl-tests-{run}", dir=beside))
        self._first_seen: dict[str, str] = {}
        self._ours: set[str] = {"home"}
        self._owner = os.getpid()
        atexit.register(self._remove)
        live_in(self.path / "home")

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
        things += [str(place) for place in sorted((self.path / "home").glob(".local/state/mastctl/heads/*"))]
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
