"""What every test of the service is asked for beside its own question."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from urllib.request import urlopen

import pytest

from hil_tests.described_answers import answers_checked
from hil_tests.mastctl.service_fakes import FakeHardware, fake_daemon
from mastctl.daemon import RunningDaemon


@pytest.fixture(scope="session")
def complaints() -> Iterator[list[str]]:
    """What daemons of this process have answered and not described."""
    with answers_checked() as found:
        yield found


@pytest.fixture(autouse=True)
def _every_answer_is_described(complaints: list[str]) -> Iterator[None]:
    complaints.clear()
    yield
    assert not complaints, "answers that /openapi.json does not describe"


@pytest.fixture
def pair(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[tuple[RunningDaemon, FakeHardware]]:
    """A daemon on fakes, and these. It has answered: what it begins when it is ready has begun."""
    with fake_daemon(monkeypatch, tmp_path) as made:
        with urlopen(f"{made[0].url}/api/v1/health/live", timeout=20.0):
            pass
        yield made
