"""What every test may use."""

from __future__ import annotations

import ctypes
import gc
import os
import signal
import tempfile
from collections import Counter
from collections.abc import Generator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from hil_tests.left_behind import OwnFolder, end_all_of

REPOSITORY = Path(__file__).resolve().parent.parent
VM_CONFTEST = REPOSITORY / "hil_tests" / "vm" / "conftest.py"
DATA = REPOSITORY / "hil_tests" / "data"
GIVE_BACK = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc's: what was freed goes to the machine
LONG_PARTS = (1, 2, 3, 4)  # of the long run; CI takes them in turns

# Whoever runs the tests may ignore signals, as nohup does and a shell for what it puts into the background;
# that is inherited, and would make daemons and commands under test ignore them too.
with suppress(ValueError):  # not the main thread
    for _number, _usual in (
        (signal.SIGHUP, signal.SIG_DFL),
        (signal.SIGQUIT, signal.SIG_DFL),
        (signal.SIGINT, signal.default_int_handler),
    ):
        if signal.getsignal(_number) is signal.SIG_IGN:
            signal.signal(_number, _usual)

# How long an example takes says how busy the machine is.
settings.register_profile("no deadline", deadline=None)
settings.load_profile("no deadline")

# A second thread of the small matrices here only waits, in as much processor time as the first one works.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

# What tests make in the temporary folder, and the state of daemons that they start, is in a folder of this
# process alone. pytest's own folders stay beside it.
# A socket's path has 100 bytes, of which pytest's folders and the names of tests take 82.
TEMPORARY = tempfile.gettempdir() if len(os.fsencode(tempfile.gettempdir())) <= 16 else "/tmp"
os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", TEMPORARY)
OWN = OwnFolder(Path(os.environ["PYTEST_DEBUG_TEMPROOT"]))
os.environ["TMPDIR"] = str(OWN.path)
tempfile.tempdir = None  # asks the environment again
os.environ["XDG_STATE_HOME"] = str(OWN.keep("state"))
os.environ["MASTCTL_HEADS"] = str(OWN.keep("heads"))
os.environ.pop("STATE_DIRECTORY", None)
LEFT = pytest.StashKey[list[str]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Name the real hardware that hil_tests/bench moves, and insist on the kernel of hil_tests/vm."""
    parser.addoption("--hardware", metavar="FILE", help="configuration of a real head for hil_tests/bench")
    parser.addoption(
        "--require-vm",
        action="store_true",
        help="fail, not skip, without the kernel of hil_tests/vm",
    )
    parser.addoption("--long", action="store_true", help="run the long tests instead of the quick ones")
    parser.addoption(
        "--long-part", type=int, choices=LONG_PARTS, help="with --long: only those of one part", metavar="N"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Declare the marker of the long run."""
    config.stash[LEFT] = []
    config.addinivalue_line(
        "markers",
        "long(part, why): left out of the quick run; belongs to one of the four parts of the long run that "
        "CI takes in turns. docs/contribute/testing.md lists these tests with their reasons",
    )


FIRST = (
    "test_on_a_real_driver", "test_closed_loop", "test_bench_suite", "test_packaging", "test_camera_sync",
    "test_campaign_tasks", "test_bench_worker", "test_page_bench", "test_soak",
)  # fmt: skip


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Keep the quick tests or the long ones; put the few files that take longest first."""
    wanted_part = config.getoption("--long-part")
    kept: list[pytest.Item] = []
    left: list[pytest.Item] = []
    for item in items:
        marker = item.get_closest_marker("long")
        if marker is None:
            runs = not config.getoption("--long")
        else:
            part, why = marker.args
            if part not in LONG_PARTS or not why:
                raise pytest.UsageError(f"{item.nodeid}: long needs a part of {LONG_PARTS} and a reason")
            runs = config.getoption("--long") and wanted_part in (None, part)
        (kept if runs else left).append(item)
    if left:
        config.hook.pytest_deselected(items=left)
    items[:] = sorted(kept, key=lambda item: item.path.stem not in FIRST)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(
    item: pytest.Item, nextitem: pytest.Item | None
) -> Generator[None, object, object]:
    """Let go of what a file's tests have left: closed rovers are circles of 90 MB, seldom collected.

    What is left then is what modules and the session keep; the next collection does not look at it again.
    """
    ran = yield
    if nextitem is None or nextitem.path != item.path:
        gc.collect()
        gc.freeze()
        if GIVE_BACK is not None:
            GIVE_BACK(0)
    return ran


def pytest_runtest_logfinish(nodeid: str) -> None:
    """Look what is in the temporary folder after each test."""
    OWN.look(nodeid)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail a run that leaves something behind; a worker tells the one who prints."""
    config = session.config
    workers = config.pluginmanager.getplugin("dsession")
    if workers is None:  # it runs tests itself
        config.stash[LEFT] += OWN.left()
    elif session.exitstatus == pytest.ExitCode.INTERRUPTED:  # its workers are gone by now
        end_all_of(workers.nodemanager.testrunuid, Path(os.environ["PYTEST_DEBUG_TEMPROOT"]))
    if hasattr(config, "workeroutput"):
        config.workeroutput["left"] = config.stash[LEFT]
        return
    if config.stash[LEFT] and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Take what a worker of xdist left."""
    node.config.stash[LEFT] += getattr(node, "workeroutput", {}).get("left", [])


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> Generator[None]:
    """Say in the last line before the counts what did not run for want of the kernel, and what mends it."""
    yield
    for thing in terminalreporter.config.stash[LEFT]:
        terminalreporter.write_line(f"LEFT BEHIND, so the run fails: {thing}", red=True)
    skipped = terminalreporter.getreports("skipped")
    reasons = Counter(
        why for path, _, why in (told.longrepr for told in skipped) if Path(path) == VM_CONFTEST
    )
    for reason, tests in reasons.items():
        what = f"{tests} test{'s' if tests > 1 else ''} on a kernel with virtual cameras"
        terminalreporter.write_line(f"not run: {what}: {reason.removeprefix('Skipped: ')}")


@pytest.fixture(scope="session")
def repository() -> Path:
    """The checkout that holds these tests."""
    return REPOSITORY


@pytest.fixture(scope="session")
def reference_data() -> Path:
    """Return the folder of reference data; its SOURCES.md says where each file comes from."""
    return DATA
