"""Places of the head that are kept by a name, for everybody and across restarts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from hil_tests.mastctl.service_fakes import CONFIG, FakeHardware, fake_daemon
from mastctl.client import Client, ClientError
from mastctl.daemon import RunningDaemon
from mastctl.errors import MastctlError
from mastctl.service.places import FILE, MOST, KeptPlace, Places

Pair = tuple[RunningDaemon, FakeHardware]
HOME = {"pan_rad": 0.0, "tilt_rad": 0.0}
CHART = {"pan_rad": 0.5, "tilt_rad": -0.25}


def refused(code: str, act: Callable[[], object]) -> str:
    with pytest.raises(ClientError) as refusal:
        act()
    assert refusal.value.code == code
    return str(refusal.value)


def test_what_one_keeps_another_sees_and_forgets(pair: Pair) -> None:
    with Client(pair[0].url, name="bench") as bench, Client(pair[0].url, name="rover") as rover:
        assert bench.places() == {"home": HOME}
        bench.keep_place("colour chart 2", **CHART)
        assert rover.places() == {"home": HOME, "colour chart 2": CHART}
        assert rover.forget_place("colour chart 2") == {"home": HOME}
        assert "no place is kept by the name 'x'" in refused("place_unknown", lambda: bench.forget_place("x"))
    assert not [call for call in pair[1].head.calls if call[0] == "move"], "nothing moves by it"


def test_home_is_another_place_until_it_is_forgotten(pair: Pair) -> None:
    with Client(pair[0].url) as client:
        assert client.keep_place("home", **CHART) == {"home": CHART}
        assert client.forget_place("home") == {"home": HOME}
        refused("place_unknown", lambda: client.forget_place("home"))


def test_places_outlive_the_daemon(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    state = tmp_path / "state"
    config = f"{CONFIG}state: {{{{folder: {state}}}}}\n"
    with fake_daemon(monkeypatch, tmp_path, config=config) as (daemon, _), Client(daemon.url) as client:
        client.keep_place("chart", **CHART)
    with fake_daemon(monkeypatch, tmp_path, config=config) as (daemon, _), Client(daemon.url) as client:
        assert client.places()["chart"] == CHART
        (state / FILE).write_text("{")
        assert FILE in refused("unreadable", client.places)
        refused("unreadable", lambda: client.keep_place("chart", **CHART))
        assert (state / FILE).read_text() == "{", "what cannot be read is not written over"
        client.wait(client.point(pan_rad=0.1, tilt_rad=0.1))


def test_a_name_that_is_none_is_refused(pair: Pair) -> None:
    with Client(pair[0].url) as client:
        for name in ("", "../latch", "a/b", " x", "x" * 41, "<b>"):
            with pytest.raises(ClientError):
                client.keep_place(name, **CHART)
        assert client.places() == {"home": HOME}


@pytest.mark.parametrize(
    "text",
    [
        '{"schema": "mastctl/places/1", "places": {"x": {"pan_rad": NaN, "tilt_rad": 0}}}',
        '{"schema": "mastctl/places/1", "places": {"x": [1, 2]}}',
        '{"schema": "mastctl/places/1", "places": [1]}',
        '{"schema": "mastctl/latch/1"}',
    ],
)
def test_a_file_of_something_else_is_refused_in_a_sentence(tmp_path: Path, text: str) -> None:
    (tmp_path / FILE).write_text(text)
    with pytest.raises(MastctlError, match=FILE) as refusal:
        Places(tmp_path).told()
    assert refusal.value.code == "unreadable"


def test_no_more_places_are_kept_than_a_page_can_show(tmp_path: Path) -> None:
    places = Places(tmp_path)
    for number in range(MOST):
        places.keep(f"place {number}", KeptPlace(0.01 * number, 0.0))
    with pytest.raises(MastctlError, match="forget one"):
        places.keep("one more", KeptPlace(0.0, 0.0))
    assert len(places.keep("place 3", KeptPlace(1.0, 0.0))["places"]) == MOST + 1, "and home"


def test_a_disk_that_takes_nothing_is_told(tmp_path: Path) -> None:
    places = Places(tmp_path / "gone")
    with pytest.raises(MastctlError, match="cannot be saved") as refusal:
        places.keep("chart", KeptPlace(0.0, 0.0))
    assert refusal.value.code == "not_saved"
