"""The configuration read again while the daemon runs: all of it, or nothing and why."""

from __future__ import annotations

import threading
from typing import Any

import pytest

from hil_tests.mastctl.service_fakes import CONFIG, FakeHardware, ScriptedLoop
from hil_tests.waiting import NET_S, present, until
from mastctl.client import Client, ClientError
from mastctl.daemon import RunningDaemon
from mastctl.devices.judge import OutsideLimits
from mastctl.errors import Stopped
from mastctl.service.masts import FIXED

Pair = tuple[RunningDaemon, FakeHardware]


def write(pair: Pair, old: str = "", new: str = "", more: str = "") -> None:
    """Change the configuration's file."""
    path = pair[0].service.config.path
    text = CONFIG.format(listen="{port: 0}")
    assert old in text
    path.write_text(text.replace(old, new) + more)


def refused(client: Client, code: str) -> str:
    """Ask for a reload that is refused; return why, and see that nothing has changed."""
    before = client.status()
    with pytest.raises(ClientError) as caught:
        client.reload()
    assert caught.value.code == code, caught.value
    after = client.status()
    assert [after[key] for key in ("limits", "mast")] == [before[key] for key in ("limits", "mast")]
    return str(caught.value)


def test_limits_come_into_use_with_the_next_command(pair: Pair, client: Client) -> None:
    write(pair, "pan_rad: [-2.0, 2.0]", "pan_rad: [-1.0, 1.0]")
    assert client.reload()["changed"] == [
        {"key": "limits.pan_rad", "before": [-2.0, 2.0], "after": [-1.0, 1.0]}
    ]
    assert client.status()["limits"]["pan_rad"] == [-1.0, 1.0]
    with pytest.raises(ClientError, match=r"beyond the (soft )?limit 1"):
        client.point(pan_rad=1.5, tilt_rad=0.0)
    with pytest.raises(OutsideLimits):
        pair[0].service.devices.move(1.5, 0.0)


def test_a_sun_of_the_configuration_comes_into_use(pair: Pair, client: Client) -> None:
    sun = "{azimuth_rad: 0.1, elevation_rad: -0.1, half_angle_rad: 0.2, frame: rover}"
    write(pair, "speed_rad_per_s: 0.5", f"speed_rad_per_s: 0.5, margin_rad: 0.02, sun: {sun}")
    client.reload()
    with pytest.raises(ClientError, match="keep-out sun"):
        client.point(pan_rad=0.1, tilt_rad=-0.1)


def test_a_head_outside_new_limits_may_only_go_back_in(pair: Pair, client: Client) -> None:
    here = present(client.status()["joints"])["pan_rad"]
    write(pair, "pan_rad: [-2.0, 2.0]", f"pan_rad: [{here + 0.3}, 2.0]")
    (note,) = client.reload()["notes"]
    assert "is where it may not be sent any more" in note
    devices = pair[0].service.devices
    with pytest.raises(OutsideLimits):
        devices.move(here + 0.1, 0.0)  # nearer, but still outside
    devices.move(here + 0.5, 0.0)


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("listen: {port: 0}", "listen: {port: 1}", "listen"),
        ("pan_tilt: {driver: fake}", "pan_tilt: {driver: other}", "pan_tilt"),
        ("pan_tilt", "simulation: {rover: a.yaml}\npan_tilt", "simulation"),
    ],
)
def test_a_key_that_needs_a_restart_is_refused_and_nothing_applied(
    standing: Pair, old: str, new: str, key: str
) -> None:
    write(standing, old, new)
    path = standing[0].service.config.path
    path.write_text(path.read_text().replace("speed_rad_per_s: 0.5", "speed_rad_per_s: 0.1"))
    with Client(standing[0].url) as client:
        words = refused(client, "restart_needed")
    assert f"{key} ({FIXED[key][1]})" in words


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[-2.0, 2.0]", "[2.0, -2.0]", "limits.pan_rad"),
        ("mast_file: little.yaml", "mast_file: [", "daemon.yaml"),
    ],
)
def test_a_broken_file_is_refused_with_its_place(standing: Pair, old: str, new: str, words: str) -> None:
    write(standing, old, new)
    with Client(standing[0].url) as client:
        assert words in refused(client, "bad_config")


def test_nothing_is_read_while_an_operation_runs(
    pair: Pair, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    def until_stopped(request: Any, record: Any, cancelled: threading.Event, devices: Any) -> None:
        assert cancelled.wait(NET_S)
        raise Stopped("stopped")

    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(until_stopped), raising=False)
    write(pair, "speed_rad_per_s: 0.5", "speed_rad_per_s: 0.1")
    client.point(pan_rad=0.1, tilt_rad=0.0)
    until(lambda: client.status()["state"] == "moving", "it moves")
    refused(client, "busy")
    client.stop()
    until(lambda: client.status()["operation"] is None, "the operation ends")
    assert client.reload()["changed"]
