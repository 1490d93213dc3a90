"""A daemon that records itself: its commands and results are in the file; routes, client, command line."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import httpx
import pytest

from drivers.recordings.mcap_file import McapEntry, read_items
from hil_tests.mastctl.recorder.recorder_world import records
from hil_tests.waiting import until
from mastctl.cli.main import main
from mastctl.client import Client, ClientError
from mastctl.config import Config, Listen, load_config
from mastctl.daemon import RunningDaemon
from mastctl.recorder.folder import RecordSettings
from mastctl.recorder.recorded import read_whole


def config_with(folder: Path, ring_s: float | None) -> Config:
    config = load_config()
    return replace(
        config,
        listen=Listen(port=0),
        hardware=replace(config.hardware, simulation={**config.hardware.simulation, "speed": "max"}),
        record=RecordSettings.model_construct(ring_s=ring_s, free_mb=0.0, folder=folder),
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("records")


@pytest.fixture(scope="module")
def daemon(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningDaemon]:
    config = config_with(folder, None)
    mast_file = tmp_path_factory.mktemp("masts") / "used.yaml"
    mast_file.write_bytes(config.mast_file.read_bytes())
    with RunningDaemon(replace(config, mast_file=mast_file)) as running:
        yield running


@pytest.fixture
def client(daemon: RunningDaemon) -> Iterator[Client]:
    with Client(daemon.url) as one:
        yield one


def test_a_run_holds_the_requests_images_and_results(client: Client, daemon: RunningDaemon) -> None:
    begun = client.start_recording("rock 7")
    assert begun["run"].endswith("-rock-7")
    with pytest.raises(ClientError, match="is recorded already") as refused:
        client.start_recording()
    assert refused.value.code == "recording"
    client.wait(client.point(pan_rad=0.0, tilt_rad=-0.1))
    shot = client.snapshot("navcam_left")
    record = client.wait(client.point(pixel=("navcam_left", shot.frame_id, 400.0, 500.0)))
    assert record["state"] == "done", record["error"]
    done = record["id"]
    path = Path(begun["folder"]) / "runs" / begun["file"]
    until(lambda: _state_of(path, done) == "done", "the operation's end is on the disk")
    ended = client.stop_recording()
    assert ended["file"] == str(path)
    recording = read_whole(path)
    assert recording.masts.keys() == {client.status()["mast"]["digest"]}
    assert recording.config is not None and recording.config.data == daemon.service.config.data
    assert recording.operations[done]["request"] == record["request"]
    assert len(recording.operations[done]["steps"]) == len(record["steps"])
    assert record["pointings"][0]["frame_id"] in recording.frames
    image = recording.frames[shot.frame_id].image()
    assert (image == shot.image).all()
    commands = [one.get("command") for one in records(path, "/command")]
    assert commands.count("point") >= 2
    assert len({one["state"] for one in records(path, "/state")}) > 1
    assert len({one["pan_rad"] for one in records(path, "/joints")}) > 1


def _state_of(path: Path, operation: str) -> str:
    states = [
        json.loads(item.message.data)
        for item in read_items(path)
        if isinstance(item, McapEntry) and item.channel.topic == "/operation"
    ]
    return next((one["state"] for one in reversed(states) if one["id"] == operation), "")


def test_the_command_line_begins_ends_and_lists(
    daemon: RunningDaemon, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    url = ["--url", daemon.url]
    assert main(["record", "start", "by hand", *url]) == 0
    assert "'mastctl record stop' ends it" in capsys.readouterr().out
    assert main(["record", "stop", *url, "--json"]) == 0
    ended = json.loads(capsys.readouterr().out)
    assert main(["record", "list", *url]) == 0
    shown = capsys.readouterr().out
    assert "by-hand" in shown and "recorder.run" in shown
    assert main(["record", "show", ended["file"]]) == 0
    assert "whole" in capsys.readouterr().out


def test_names_that_would_leave_the_folder_stay_in_it(client: Client, folder: Path) -> None:
    begun = client.start_recording("../../etc/passwd\n")
    ended = client.stop_recording()
    assert Path(ended["file"]).parent == folder / "runs" and "passwd" in begun["file"]
    with pytest.raises(ClientError) as refused:
        client.start_recording("x" * 100)
    assert refused.value.code == "bad_request"


def test_a_recording_is_read_and_deleted_by_its_name_only(client: Client, daemon: RunningDaemon) -> None:
    with httpx.Client(base_url=f"{daemon.url}/api/v1/recordings", trust_env=False) as http:

        def refused(method: str, path: str) -> str:
            answer = http.request(method, path)
            return "" if answer.is_success else answer.json()["error"]["code"]

        begun = client.start_recording("to go")
        run, file = begun["run"], begun["file"]
        assert refused("GET", f"/{run}/{file}") == "recording"
        assert refused("DELETE", f"/{run}") == "recording"
        ended = client.stop_recording()
        whole = http.get(f"/{run}/{file}", headers={"Range": "bytes=0-9"})
        assert (whole.status_code, whole.content) == (200, Path(ended["file"]).read_bytes())
        for path in ("/nothing", "/..%2Fruns", "/%2E%2E"):
            assert refused("DELETE", path) in ("recording_unknown", "not_found", "method_not_allowed"), path
        assert refused("GET", f"/{run}/..%2F{file}") in ("recording_unknown", "not_found")
        assert Path(ended["file"]).exists()
        left = client.request("DELETE", f"/recordings/{run}")["recordings"]
        assert run not in [one["name"] for one in left] and not Path(ended["file"]).exists()
        assert refused("DELETE", f"/{run}") == "recording_unknown"


def test_a_fault_of_the_head_keeps_what_was_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mastctl.recorder.recorder.AFTER_FAULT_S", 0.2)
    config = config_with(tmp_path, 60.0)
    config = replace(config, hardware=replace(config.hardware, simulation=load_config().hardware.simulation))
    with RunningDaemon(config) as daemon, Client(daemon.url) as client:
        client.wait(client.point(pan_rad=0.2, tilt_rad=-0.1))
        client.set_fault("pan_tilt", "off")
        until(lambda: client.status()["faults"], "the fault is reported")
        until(lambda: list((tmp_path / "kept").glob("*/*.mcap")), "the ring is kept")
    (kept,) = (tmp_path / "kept").iterdir()
    assert "pan_tilt" in kept.name
    recording = read_whole(kept)
    assert any(one["state"] == "done" for one in recording.operations.values())


def test_of_real_hardware_there_is_a_ring_unless_it_is_forbidden() -> None:
    assert RecordSettings().ring_of("real") == 300.0 and RecordSettings().ring_of("mixed") == 300.0
    assert RecordSettings().ring_of("simulated") == 0.0 and RecordSettings().ring_of("replayed") == 0.0
    assert RecordSettings(ring_s=0.0).ring_of("real") == 0.0
    assert RecordSettings(ring_s=5.0).ring_of("simulated") == 5.0
