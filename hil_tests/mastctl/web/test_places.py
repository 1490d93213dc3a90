"""Places of the head that are kept by a name, for everybody and across restarts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hil_tests.mastctl.service_fakes import CONFIG, FakeHardware, fake_daemon
from mastctl.client import Client, ClientError
from mastctl.daemon import RunningDaemon

Pair = tuple[RunningDaemon, FakeHardware]
FILE = "places.json"
HOME = {"pan_rad": 0.0, "tilt_rad": 0.0}
CHART = {"pan_rad": 0.5, "tilt_rad": -0.25}
CHART_2 = "colour%20chart%202"


def places(client: Client) -> Any:
    return client.request("GET", "/places")["places"]


def refused(code: str, act: Callable[[], object]) -> str:
    with pytest.raises(ClientError) as refusal:
        act()
    assert refusal.value.code == code
    return str(refusal.value)


def test_what_one_keeps_another_sees_and_forgets(pair: Pair) -> None:
    with Client(pair[0].url, name="bench") as bench, Client(pair[0].url, name="rover") as rover:
        assert places(bench) == {"home": HOME}
        bench.request("POST", f"/places/{CHART_2}", **CHART)
        assert places(rover) == {"home": HOME, "colour chart 2": CHART}
        assert rover.request("DELETE", f"/places/{CHART_2}") == {"places": {"home": HOME}}
        assert "no place is kept by the name 'x'" in refused(
            "place_unknown", lambda: bench.request("DELETE", "/places/x")
        )
    assert not [call for call in pair[1].head.calls if call[0] == "move"], "nothing moves by it"


def test_places_outlive_the_daemon(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    state = tmp_path / "state"
    config = f"{CONFIG}state: {{{{folder: {state}}}}}\n"
    with fake_daemon(monkeypatch, tmp_path, config=config) as (daemon, _), Client(daemon.url) as client:
        client.request("POST", "/places/chart", **CHART)
    with fake_daemon(monkeypatch, tmp_path, config=config) as (daemon, _), Client(daemon.url) as client:
        assert places(client)["chart"] == CHART
        (state / FILE).write_text("{")
        assert FILE in refused("unreadable", lambda: places(client))
        refused("unreadable", lambda: client.request("POST", "/places/chart", **CHART))
        assert (state / FILE).read_text() == "{", "what cannot be read is not written over"
        client.wait(client.point(pan_rad=0.1, tilt_rad=0.1))
