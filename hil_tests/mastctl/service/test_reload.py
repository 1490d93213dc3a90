"""The configuration read again while the daemon runs: all of it, or nothing and why."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from calib.files.mast_file import save_rig
from calib.geometry.rig import Mast
from hil_tests.mastctl.service_fakes import CONFIG, FakeHardware, ScriptedLoop, rig
from hil_tests.waiting import NET_S, joined, until
from mastctl.client import Client, ClientError
from mastctl.daemon import RunningDaemon
from mastctl.devices.limits import Limits, OutsideLimits
from mastctl.errors import Stopped
from mastctl.motion.settings import PointingSettings
from mastctl.service import reload as reload_module
from mastctl.service import steering as steering_module
from mastctl.service.reload import FIXED

Pair = tuple[RunningDaemon, FakeHardware]


@pytest.fixture
def client(pair: Pair) -> Iterator[Client]:
    with Client(pair[0].url, name="bench") as made:
        yield made


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


def test_nothing_changes_where_nothing_was_written(client: Client) -> None:
    told = client.reload()
    assert (told["changed"], told["notes"]) == ([], [])


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


def test_pointings_repeat_a_residual_when_the_new_configuration_says(
    pair: Pair, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    used: list[float] = []

    class Loop(ScriptedLoop):
        def __init__(self, *given: Any) -> None:
            used.append(given[-1].repeat_after_s)
            super().__init__(*given)

    monkeypatch.setattr(steering_module, "PointingLoop", Loop)
    write(pair, "pan_tilt", "pointing: {repeat_after_s: 0.25}\npan_tilt")
    client.reload()
    write(pair)
    client.reload()
    assert used == [0.25, PointingSettings().repeat_after_s]


def test_a_head_that_stands_outside_new_limits_may_go_back_in_and_no_further(
    pair: Pair, client: Client
) -> None:
    here = client.status()["joints"]["pan_rad"]
    write(pair, "pan_rad: [-2.0, 2.0]", f"pan_rad: [{here + 0.3}, 2.0]")
    (note,) = client.reload()["notes"]
    assert "stands where it may not be sent any more" in note
    devices = pair[0].service.devices
    with pytest.raises(OutsideLimits):
        devices.move(here + 0.1, 0.0)  # nearer, but still outside
    devices.move(here + 0.5, 0.0)


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("listen: {port: 0}", "listen: {port: 1}", "listen"),
        ("pan_tilt: {driver: fake}", "pan_tilt: {driver: other}", "pan_tilt"),
        (", hazcam_left: {driver: fake}", "", "cameras"),
        ("pan_tilt", "simulation: {rover: a.yaml}\npan_tilt", "simulation"),
        ("pan_tilt", "state: {folder: elsewhere}\npan_tilt", "state"),
        ("pan_tilt", "record: {folder: elsewhere}\npan_tilt", "record.folder"),
        ("pan_tilt", "tracking: {handoff_log: a.jsonl}\npan_tilt", "tracking.handoff_log"),
    ],
)
def test_what_is_opened_at_the_start_is_refused_by_key_and_nothing_is_applied(
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
        ("schema: mastctl/config/1", "schema: other/1", "schema"),
        ("mast_file: little.yaml", "mast_file: [", "daemon.yaml"),
        ("speed_rad_per_s: 0.5", "speed: 0.5", "speed"),
    ],
)
def test_a_broken_file_is_refused_with_its_place(standing: Pair, old: str, new: str, words: str) -> None:
    write(standing, old, new)
    with Client(standing[0].url) as client:
        assert words in refused(client, "bad_config")


def test_a_file_that_is_gone_is_refused(pair: Pair, client: Client) -> None:
    pair[0].service.config.path.unlink()
    refused(client, "bad_config")


def another(pair: Pair, file: str, **changes: Any) -> None:
    save_rig(replace(rig(), **changes), pair[0].service.config.path.parent / file)


def test_another_mast_file_comes_into_use_and_the_former_is_at_hand(pair: Pair, client: Client) -> None:
    another(pair, "better.yaml", mast=Mast(np.array([0.31, 0.0, -1.41]), np.zeros(3)))
    write(pair, "little.yaml", "better.yaml")
    told = client.reload()
    assert told["mast"]["file"] == "better.yaml"
    status = client.status()
    assert (status["mast"]["file"], status["former_mast"]["file"]) == ("better.yaml", "little.yaml")


def test_a_mast_file_that_was_written_anew_comes_into_use(pair: Pair, client: Client) -> None:
    before = client.status()["mast"]["digest"]
    another(pair, "little.yaml", name="anew")
    assert client.reload()["mast"]["digest"] != before
    assert client.status()["mast"]["name"] == "anew"


def test_a_mast_file_that_a_command_has_put_into_use_stays(pair: Pair, client: Client) -> None:
    another(pair, "better.yaml", name="better")
    pair[0].service.masts.load("better.yaml")
    write(pair, "speed_rad_per_s: 0.5", "speed_rad_per_s: 0.4")
    assert client.reload()["mast"]["file"] == "better.yaml"
    assert client.status()["limits"]["speed_rad_per_s"] == 0.4


def test_a_mast_file_without_a_configured_camera_changes_nothing(pair: Pair, client: Client) -> None:
    cameras = {name: one for name, one in rig().cameras.items() if name != "hazcam_left"}
    stereo = {name: eyes for name, eyes in rig().stereo.items() if "hazcam_left" not in eyes}
    another(pair, "poor.yaml", cameras=cameras, stereo=stereo)
    path = pair[0].service.config.path
    write(pair, "little.yaml", "poor.yaml")
    path.write_text(path.read_text().replace("speed_rad_per_s: 0.5", "speed_rad_per_s: 0.1"))
    assert "hazcam_left" in refused(client, "bad_mast_file")


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


def test_two_reloads_at_once_change_it_once(
    pair: Pair, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(pair, "speed_rad_per_s: 0.5", "speed_rad_per_s: 0.1")
    first_reads, go_on = threading.Event(), threading.Event()
    load = reload_module.load_config

    def slow(path: Any) -> Any:
        first_reads.set()
        assert go_on.wait(NET_S)
        return load(path)

    monkeypatch.setattr(reload_module, "load_config", slow)
    told: list[Any] = []
    threads = [
        threading.Thread(target=lambda: told.append(reload_module.reload(pair[0].service))) for _ in range(2)
    ]
    for thread in threads:
        thread.start()
    assert first_reads.wait(NET_S)
    go_on.set()
    joined(*threads)
    assert sorted(len(one["changed"]) for one in told) == [0, 1]


def test_the_manager_hears_of_a_reload_that_is_refused_too(
    pair: Pair, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard: list[str] = []
    manager = pair[0].service.manager
    for word in ("reloading", "ready"):
        monkeypatch.setattr(manager, word, lambda word=word: heard.append(word))
    client.reload()
    write(pair, "mast_file: little.yaml", "mast_file: [")
    refused(client, "bad_config")
    assert heard == 2 * ["reloading", "ready"]


def test_limits_that_the_head_does_not_keep_leave_all_as_it_was(
    pair: Pair, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    from drivers.interfaces import AxisMotion

    door = pair[0].service.devices.door
    monkeypatch.setattr(door, "_stated", {"pan": AxisMotion(5.0)})
    write(pair, "speed_rad_per_s: 0.5", "speed_rad_per_s: 0.1, acceleration_rad_per_s2: 1.0")
    assert "acceleration_rad_per_s2" in refused(client, "bad_config")
    assert door.limits == Limits((-2.0, 2.0), (-1.0, 1.0), 0.5)
