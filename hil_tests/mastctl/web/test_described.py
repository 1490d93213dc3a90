"""Every route's answer has a model, and whoever asks everything gets no answer that is not described."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from hil_tests.mastctl.service_fakes import HTTP, fake_daemon
from hil_tests.waiting import until
from mastctl.client import Client
from mastctl.http import PREFIX
from mastctl.web.app import api
from mastctl.web.described import EVENTS, FILES, answers_of
from tools.campaigns.fuzz_daemon import UNASKED, ask, taken_back

FUZZ_S = 30.0
EXAMPLES, FEWER = 4, 2  # of each route, twice


def test_every_route_has_a_model_a_kind_of_file_or_events_and_no_other_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with fake_daemon(monkeypatch, tmp_path) as (daemon, _):
        document = HTTP.get(f"{daemon.url}/openapi.json").json()
    routes = {
        f"{method.upper()} {path.removeprefix(PREFIX)}"
        for path, methods in document["paths"].items()
        for method in methods
    }
    answers = answers_of(api())
    assert routes == {*answers, *EVENTS, *FILES}
    schemas = document["components"]["schemas"]
    for name in {*(one.__name__ for one in answers.values()), *EVENTS.values()}:
        told = schemas[name]
        assert told.get("properties") or told["oneOf"], name
        assert "additionalProperties" not in told, "clients live with keys that come later"


def test_three_routes_are_not_asked_and_what_has_the_others_refused_is_taken_back(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    unasked = {route.partition(" ")[2] for route in (*answers_of(api()), *EVENTS, *FILES)}
    unasked = {path for path in unasked if re.search(UNASKED, PREFIX + path)}
    assert unasked == {"/events", "/track/stream", "/health/ready"}
    with fake_daemon(monkeypatch, tmp_path) as (daemon, _), Client(daemon.url) as client:
        client.estop()
        client.acquire_lease("somebody", 3600.0)
        with taken_back(daemon.url):
            until(lambda: client.control() is None, "the lease is released")
            until(lambda: client.status()["estop"] is None, "the stop is reset")
        client.wait(client.point(pan_rad=0.1, tilt_rad=0.1))


def test_whatever_is_asked_the_answer_is_as_described(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with fake_daemon(monkeypatch, tmp_path) as (daemon, _):
        check(daemon.url, capfd, None, FEWER, seed=1)
        done = r'commands_total{command="(point|jog|track.stop|record.start|reload)",result="ok"}'
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
