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
    from hil_tests.mastctl.service_fakes import FakeHardware
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
