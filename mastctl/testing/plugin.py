"""The pytest plug-in: ``mast_daemon``, ``mast_client``, ``simulated_rover`` and ``fault``.

pytest loads it at every start of every project beside which mastctl is installed. So it imports only pytest
and the standard library, and starts no process until a test uses a fixture.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable

    from mastctl.client import Client
    from mastctl.testing.rover import RoverProcess, SetFault, SimulatedRover

MARKER = "mastctl"
DRIVERS = "mastctl.testing.drivers"
USUAL_WIDTH_PX = 640
AS_CONFIGURED = "as_configured"

OPTIONS = ("config", "picture_width_px", "speed", "seed", "samples")
"""Keywords of the marker that a project's configuration may have too, as ``mastctl_NAME``."""

_LOG = pytest.StashKey[tuple[Path, int]]()
"""The daemons' log, and how much of it is of before."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Declare the options of a project's configuration."""
    for name in OPTIONS:
        meaning = f"{name} of every test's simulated rover, as the marker {MARKER} has it"
        parser.addini(f"{MARKER}_{name}", meaning, type="string", default="")


def pytest_load_initial_conftests(early_config: pytest.Config, args: list[str]) -> None:
    """Load the options of the acceptance of drivers where that is on the command line."""
    if any(DRIVERS in one or DRIVERS.replace(".", os.sep) in one for one in args):
        early_config.pluginmanager.import_plugin(f"{DRIVERS}.plugin")


def pytest_configure(config: pytest.Config) -> None:
    """Declare the markers."""
    config.addinivalue_line("markers", "moves_head: an acceptance test of a driver that moves the head")
    config.addinivalue_line(
        "markers",
        f"{MARKER}(config=None, picture_width_px=None, **simulation): the test's simulated rover; further "
        "keywords are keys of the configuration's simulation section",
    )


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> None:
    """Show with a failure what the test's daemon logged."""
    file, read = item.stash.get(_LOG, (None, 0))
    if file is not None and call.excinfo is not None:
        data = file.read_bytes()[read:]
        item.stash[_LOG] = (file, read + len(data))
        item.add_report_section(call.when, MARKER, data.decode(errors="replace"))


@pytest.fixture(scope="session")
def _mast_process(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[], RoverProcess]]:
    """Returns the process of this worker's daemons: made when first wanted, and anew if it has died."""
    folder, made = tmp_path_factory.mktemp("mastctl"), list[Any]()

    def process() -> RoverProcess:
        from mastctl.testing.rover import RoverProcess

        if not made or not made[-1].alive:
            workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
            made.append(RoverProcess(folder / "daemon.log", workers))
        found: RoverProcess = made[-1]
        return found

    yield process
    for one in made:
        one.close()


@pytest.fixture
def simulated_rover(
    request: pytest.FixtureRequest,
    _mast_process: Callable[[], RoverProcess],
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[SimulatedRover]:
    """The simulated rover of this test, with a daemon of its own that has just started."""
    from mastctl.testing.rover import START_S, RoverError, SimulatedRover

    process = _mast_process()
    request.node.stash[_LOG] = (process.log, process.log.stat().st_size)
    url = refusal = ""
    try:
        options = _options(request)
        folder = str(tmp_path_factory.mktemp("rover"))
        url = process.request("open", START_S, **options, folder=folder)
    except (RoverError, ValueError) as error:
        refusal = str(error)
    if refusal:
        pytest.fail(f"no simulated rover for this test: {refusal}", pytrace=False)
    yield SimulatedRover(process.request, url)
    try:
        process.request("close")
    except RoverError:  # it has died, or hangs: the next test gets another one
        process.close()


@pytest.fixture
def mast_daemon(simulated_rover: SimulatedRover) -> str:
    """The address of this test's daemon, ``http://127.0.0.1:PORT``."""
    return simulated_rover.url


@pytest.fixture
def mast_client(mast_daemon: str) -> Iterator[Client]:
    """A `mastctl.client.Client` of this test's daemon."""
    from mastctl.client import Client

    with Client(mast_daemon) as client:
        yield client


@pytest.fixture
def fault(simulated_rover: SimulatedRover) -> Callable[..., SetFault]:
    """``fault(device, word, **parameters)`` sets a fault; the end of the test clears it."""
    return simulated_rover.set_fault


def _options(request: pytest.FixtureRequest) -> dict[str, Any]:
    """The options of the marker and the project's configuration. Raises ValueError."""
    wanted: dict[str, Any] = {"config": None, "picture_width_px": USUAL_WIDTH_PX}
    for name in OPTIONS:
        if text := str(request.config.getini(f"{MARKER}_{name}")).strip():
            wanted[name] = _value(text)
    for marker in reversed([*request.node.iter_markers(MARKER)]):  # the closest one last
        if marker.args:
            raise ValueError(f"the marker {MARKER} takes keywords only, found {marker.args[0]!r}")
        wanted |= marker.kwargs
    config, width_px = wanted.pop("config"), wanted.pop("picture_width_px")
    if config is not None:
        config = str(request.config.rootpath / str(config))
    return {
        "config": config,
        "picture_width_px": None if width_px == AS_CONFIGURED else width_px,
        "simulation": wanted,
    }


def _value(text: str) -> int | float | str:
    """A number of the project's configuration, or another text; what reads it judges it."""
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return text
