"""What-if beside the truth: the simulator's pointings with a wrong mast file, worked out with the right one,
against those that the right one really makes.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.files.mast_file import load_rig, save_rig
from calib.geometry.rig import Mast, Rig
from hil_tests.mastctl.drift.small_rover import small
from hil_tests.mastctl.recorder.recorder_world import CONFIG
from mastctl.cli.main import main
from mastctl.client import Client
from mastctl.config import Listen, load_config
from mastctl.control.publisher import Publisher
from mastctl.daemon import RunningDaemon
from mastctl.recorder.entries import AttachedMast
from mastctl.recorder.folder import RecordSettings
from mastctl.recorder.recorded import Recording, read_whole
from mastctl.recorder.recorder import Recorder
from mastctl.recorder.what_if import seen_in, what_if
from mastctl.recorder.writer import Attached

CLICKS_PX = ((150.0, 250.0), (350.0, 300.0), (100.0, 325.0))
ROUNDED_PX = 1e-3  # the record's pixels have four digits


def wrong_mast(right: Rig) -> Rig:
    """A mast that was put on again a little turned, after its axes were dismounted."""
    mast = right.mast
    turned = mast.rotation_rad + np.array([0.0, 0.002, -0.003])
    return replace(
        right, mast=Mast(mast.translation_m, turned, mast.axis_offset_m + 0.003, mast.axis_twist_rad + 0.003)
    )


def recorded(mast_file: Path, true_file: Path, folder: Path) -> Path:
    """Point at some pixels with a mast file, and record it; return the recording."""
    config = load_config()
    simulation = {**config.hardware.simulation, "speed": "max", "rover": str(true_file)}
    cameras = {name: one for name, one in config.hardware.cameras.items() if name.startswith("navcam")}
    config = replace(
        config,
        listen=Listen(port=0),
        mast_file=mast_file,
        hardware=replace(config.hardware, simulation=simulation, cameras=cameras),
    )
    stored = load_rig(mast_file)
    mast = AttachedMast(stored.rig, Attached(mast_file.name, mast_file.read_bytes()))
    settings = RecordSettings.model_construct(ring_s=0.0, free_mb=0.0)
    attached = [replace(CONFIG, data=Path(config.path).read_bytes())]
    with RunningDaemon(config) as daemon, Client(daemon.url) as client:
        publisher, service = Publisher(), daemon.service
        facts = {"hardware": "simulated"}
        find = service.devices.store.by_id
        answers, clock = service.event_value, service.clock
        recorder = Recorder(settings, folder, lambda: mast, attached, facts, publisher, find, answers, clock)
        recorder.start_run("")
        for x_px, y_px in CLICKS_PX:
            client.wait(client.point(pan_rad=0.0, tilt_rad=-0.1))
            shot = client.snapshot("navcam_left")
            done = client.point(pixel=("navcam_left", shot.frame_id, x_px, y_px), pointings=2)
            record = client.wait(done)
            assert record["state"] == "done", record["error"]
            for pointing in record["pointings"]:
                frame = find(pointing["frame_id"])
                publisher.publish("frame", frame.camera, frame)
            publisher.publish("operation", done, service.operations.get(done))
        file = Path(recorder.stop_run()["file"])
        recorder.close()
    return file


@pytest.fixture(scope="module")
def files(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """On Navcams of few pixels: drawing takes most of the time."""
    folder = tmp_path_factory.mktemp("what_if")
    save_rig(small(load_rig(repository / "configs/sim/rocky8.yaml").rig), folder / "true.yaml")
    right = small(load_rig(load_config().mast_file).rig)
    found = {"right": folder / "right.yaml", "wrong": folder / "wrong.yaml"}
    save_rig(right, found["right"])
    save_rig(wrong_mast(right), found["wrong"])
    true = folder / "true.yaml"
    return found | {f"{name} run": recorded(path, true, folder / name) for name, path in found.items()}


def would_be(recording: Recording, mast_file: Path) -> list[dict[str, Any]]:
    document = what_if(recording, load_rig(mast_file))
    assert set(document["not_worked_out"].values()) <= {"it turned the head to angles, without a target"}
    return list(document["pointings"])


def test_the_right_mast_file_leaves_what_it_really_leaves(files: dict[str, Path]) -> None:
    expected = would_be(read_whole(files["wrong run"]), files["right"])
    real = would_be(read_whole(files["right run"]), files["right"])
    first = [one for one in expected if one["pointing"] == 1]
    assert len(first) == len(CLICKS_PX)
    before = np.array([one["recorded_px"] for one in first])
    assert np.abs(before).max() > 0.25  # the wrong file is felt, in these coarse pixels
    off, sigma = [], []
    for one, other in zip(expected, real, strict=True):
        off.append(np.subtract(one["would_be_px"], other["recorded_px"]))
        sigma.append(one["sigma_px"])
    in_sigmas = np.abs(np.array(off)) / np.array(sigma)
    assert in_sigmas.max() < 3.5, in_sigmas
    assert np.sqrt(np.mean(np.square(in_sigmas))) < 1.6, in_sigmas
    assert np.array(sigma).max() < 0.15  # and the sigma says something


def test_with_its_own_mast_file_the_recorded_residuals_come_out(files: dict[str, Path]) -> None:
    for one in would_be(read_whole(files["wrong run"]), files["wrong"]):
        assert one["would_be_px"] == pytest.approx(one["recorded_px"], abs=ROUNDED_PX)


def test_the_command_shows_each_pointing_and_their_rms(
    files: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["record", "replay", str(files["wrong run"]), "--mast", str(files["right"])]
    assert main([*command, "--json"]) == 0
    answer: dict[str, Any] = json.loads(capsys.readouterr().out)
    row = answer["rms_px"]["first pointing"]
    assert np.hypot(*row["would_be"]) < 0.2 * np.hypot(*row["recorded"])
    first = np.array([one["recorded_px"] for one in answer["pointings"] if one["pointing"] == 1])
    assert row["recorded"] == pytest.approx(np.sqrt(np.mean(first**2, axis=0)))
    assert answer["mast"]["name"] == "right.yaml" and answer["recorded_mast"]["name"] == "wrong.yaml"
    assert main(command) == 0
    shown = capsys.readouterr().out
    assert "would be rms" in shown and f"{first[0][0]:.3f}, {first[0][1]:.3f}" in shown


def test_what_cannot_be_worked_out_is_named() -> None:
    records: dict[str, dict[str, Any]] = {
        "1": {"state": "done", "request": {"position_m": [1, 2, 3]}, "pointings": [{}]},
        "2": {"state": "failed", "request": {"pixel": {"camera": "a"}}, "error": {"message": "it was flat"}},
        "3": {"state": "done", "request": {"pixel": {"camera": "a"}}, "pointings": [{"target_px": [1, 2]}]},
        "4": {"state": "done", "request": {"pan_rad": [-1.0, 1.0], "panorama": "p"}, "pointings": []},
        "5": {"state": "done", "request": {"pan_rad": 0.0, "tilt_rad": 0.0}, "pointings": [{}]},
        "6": {"state": "done", "request": {"panorama": {"id": "p", "by_direction": True}}, "pointings": [{}]},
        "7": {
            "state": "done", "request": {"pixel": {"camera": "a"}, "range_m": 4.0}, "range_from": "given",
            "pointings": [{"target_px": [1, 2]}],
        },
    }  # fmt: skip
    seen, others = seen_in(records, {})
    assert seen == []
    assert others["1"] == "it pointed at a position, and no image shows which pixel that is"
    assert others["4"] == "it took a panorama, in which no target was chosen"
    assert others["5"] == "it turned the head to angles, without a target"
    assert others["6"] == "it pointed in the direction of a panorama's pixel, and compared no images"
    assert others["7"] == "it pointed with one camera, and no pair saw the target"
    assert others["2"] == "it failed: it was flat"
    assert others["3"].startswith("its record does not hold enough")


def test_a_recording_is_served_as_it_was(files: dict[str, Path], tmp_path: Path) -> None:
    from mastctl.recorder.recorded import replay_files

    recording = read_whole(files["wrong run"])
    config = load_config(replay_files(recording, tmp_path, {"port": 0}))
    frames = [frame for frame in recording.frames.values() if not frame.facts["moving"]]
    with RunningDaemon(config) as daemon, Client(daemon.url) as client:
        status = client.status()
        assert status["hardware"] == "replayed"
        assert status["mast"]["digest"] == load_rig(files["wrong"]).digest
        for frame in frames[:2]:
            facts = frame.facts
            record = client.wait(client.point(pan_rad=facts["pan_rad"], tilt_rad=facts["tilt_rad"]))
            assert record["state"] == "done", record["error"]
            taken = daemon.service.snapshot(facts["camera"], True)
            assert taken.pan_rad == pytest.approx(facts["pan_rad"], abs=2e-5)
            assert np.array_equal(taken.image, frame.image())
