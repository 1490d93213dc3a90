"""Commands that are run in this process, against a daemon on fakes."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from hil_tests.mastctl.service_fakes import FakeHardware
from mastctl.cli.main import main
from mastctl.daemon import RunningDaemon

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(pair: tuple[RunningDaemon, FakeHardware], capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command against the daemon: exit code, stdout, stderr."""

    def call(*words: str) -> tuple[int, str, str]:
        capsys.readouterr()
        code = main([*words, "--url", pair[0].url])
        out, log = capsys.readouterr()
        return code, out.strip(), log

    return call
