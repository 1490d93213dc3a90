"""Every route's answer has a model, and whoever asks everything gets no answer that is not described."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from hil_tests.mastctl.service_fakes import HTTP, fake_daemon
from hil_tests.support.daemon_attacks import ask
from hil_tests.waiting import until

FUZZ_S = 30.0
EXAMPLES, FEWER = 4, 2  # of each route, twice


def test_whatever_is_asked_the_answer_is_as_described(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with fake_daemon(monkeypatch, tmp_path) as (daemon, _):
        check(daemon.url, capfd, None, FEWER, seed=1)
        done = r'commands_total{command="(point|jog|track.stop|record.start)",result="ok"}'
        until(lambda: re.search(done, HTTP.get(f"{daemon.url}/metrics").text), "some were carried out")


@pytest.mark.long(2, "half a minute by the clock; the edges of each form too, some 2,700 requests")
def test_whatever_is_asked_for_a_while_the_answer_is_as_described(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with fake_daemon(monkeypatch, tmp_path) as (daemon, _):
        check(daemon.url, capfd, FUZZ_S, EXAMPLES)


def check(
    url: str,
    capfd: pytest.CaptureFixture[str],
    seconds: float | None,
    examples: int,
    seed: int | None = None,
) -> None:
    """Have a daemon asked, and nothing may be wrong."""
    code = ask(url, seconds, examples, seed)
    told = capfd.readouterr().out[-6000:].encode("ascii", "backslashreplace").decode()  # xdist sends UTF-8
    assert code == 0, told
