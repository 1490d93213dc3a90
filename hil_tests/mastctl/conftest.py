"""What every test of the service is asked for beside its own question."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.request import urlopen

import pytest

from hil_tests.waiting import NET_S

if TYPE_CHECKING:
    import httpx

    from hil_tests.mastctl.service_fakes import FakeHardware
    from mastctl.client import Client
    from mastctl.daemon import RunningDaemon


@pytest.fixture(scope="session")
def complaints() -> Iterator[list[str]]:
    """What daemons of this process have answered and not described."""
    from hil_tests.described_answers import answers_checked

    with answers_checked() as found:
        yield found


def _starts_daemons() -> bool:
    """Whether any file of this process may; the daemon is slow to load for one that does not."""
    return "mastctl.daemon" in sys.modules


@pytest.fixture(scope="module", autouse=True)
def _daemons_of_whole_files_are_asked_too(request: pytest.FixtureRequest) -> None:
    if _starts_daemons():
        request.getfixturevalue("complaints")


@pytest.fixture(autouse=True)
def _every_answer_is_described(request: pytest.FixtureRequest) -> Iterator[None]:
    if not _starts_daemons():
        yield
        return
    complaints = request.getfixturevalue("complaints")
    complaints.clear()
    yield
    assert not complaints, "answers that /openapi.json does not describe"


@pytest.fixture
def pair(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[tuple[RunningDaemon, FakeHardware]]:
    """A daemon on fakes, and these. It has answered: what it begins when it is ready has begun."""
    from hil_tests.mastctl.service_fakes import fake_daemon

    with fake_daemon(monkeypatch, tmp_path) as made:
        with urlopen(f"{made[0].url}/api/v1/health/live", timeout=NET_S):
            pass
        yield made


@pytest.fixture(scope="module")
def standing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[RunningDaemon, FakeHardware]]:
    """A daemon on fakes for a file's questions that change nothing."""
    from hil_tests.mastctl.service_fakes import fake_daemon

    with (
        pytest.MonkeyPatch.context() as patch,
        fake_daemon(patch, tmp_path_factory.mktemp("standing")) as made,
    ):
        yield made


@pytest.fixture
def daemon(pair: tuple[RunningDaemon, FakeHardware]) -> RunningDaemon:
    """The daemon of the test's pair."""
    return pair[0]


@pytest.fixture
def hardware(pair: tuple[RunningDaemon, FakeHardware]) -> FakeHardware:
    """Its devices."""
    return pair[1]


@pytest.fixture
def web(daemon: RunningDaemon) -> Iterator[httpx.Client]:
    """A plain HTTP client of its interface."""
    import httpx

    from hil_tests.mastctl.service_fakes import PLAIN

    with httpx.Client(base_url=f"{daemon.url}/api/v1", **PLAIN) as made:
        yield made


@pytest.fixture
def client(daemon: RunningDaemon) -> Iterator[Client]:
    """A client of it that tells its name."""
    from mastctl.client import Client

    with Client(daemon.url, name="bench") as made:
        yield made
