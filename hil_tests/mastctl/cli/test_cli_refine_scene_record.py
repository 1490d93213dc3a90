"""``calibrate --refine-scene`` on records of a simulated rover whose camera is not as believed."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from calib.calibrate.scene.features import find_features
from calib.calibrate.scene.fit import left_px
from calib.calibrate.scene.terms import SceneView
from calib.files.mast_file import load_rig, save_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Rig, RigCamera
from calib.geometry.rigid import Rigid
from calib.matching.warp import grey
from drivers.recordings.frames import read_recording
from mastctl.cli.main import main
from mastctl.client import Client
from mastctl.config import Listen, load_config
from mastctl.daemon import RunningDaemon
from mastctl.recorder.settings import RecordSettings

ROOT = Path(__file__).parents[3]
CAMERA = "navcam"
TURN_RAD = np.array([1.5e-3, -2.0e-3, 2.5e-3])
"""By which the true camera is turned against the mast file's, about the head's axes."""

RESTS = [
    (pan, tilt)
    for tilt, pans in ((-0.2, (-1.2, -0.7, -0.2, 0.3, 0.8)), (-0.5, (0.9, 0.4, -0.1, -0.6, -1.1)))
    for pan in pans
]
OTHER_RESTS = [(-0.45, -0.3), (0.05, -0.35), (0.5, -0.3)]


@dataclass(frozen=True)
class Recorded:
    """The mast file in use, a run that was recorded, and another one of other rests."""

    mast: Path
    run: Path
    other: Path


def turned_back(model: CameraModel) -> CameraModel:
    """The camera turned about its C by the opposite of what is to be found, small turn by small turn."""
    for axis in (2, 1, 0):
        c, s = np.cos(-TURN_RAD[axis]), np.sin(-TURN_RAD[axis])
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        turn = np.eye(3)
        turn[i, i] = turn[j, j] = c
        turn[i, j], turn[j, i] = -s, s
        model = model.moved(Rigid(turn, model.C - turn @ model.C))
    return model


def recorded_of(folder: Path, *rounds: list[tuple[float, float]]) -> tuple[Path, list[Path]]:
    """The mast file, and what a daemon recorded of each round of rests: the true rig has a known turn."""
    true = load_rig(ROOT / "configs" / "sim" / "one_camera.yaml").rig
    camera = RigCamera("head", turned_back(true.cameras[CAMERA].model))
    mast = save_rig(Rig("bumped", true.mast, {CAMERA: camera}), folder / "mast.yaml").path
    config = load_config(ROOT / "configs" / "one_camera.yaml")
    config = replace(
        config,
        mast_file=mast,
        listen=Listen(port=0),
        hardware=replace(config.hardware, simulation={**config.hardware.simulation, "speed": "max"}),
        record=RecordSettings(ring_s=None, free_mb=0.0, folder=folder / "records"),
    )
    with RunningDaemon(config) as daemon, Client(daemon.url) as client:
        runs = []
        for rests in rounds:
            client.start_recording("round")
            for pan, tilt in rests:
                client.wait(client.point(pan_rad=pan, tilt_rad=tilt))
                client.snapshot(CAMERA)
            runs.append(Path(client.stop_recording()["file"]))
    return mast, runs


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """A look all round, and one at other rests."""
    mast, runs = recorded_of(tmp_path_factory.mktemp("scene"), RESTS, OTHER_RESTS)
    return Recorded(mast, *runs)


@pytest.fixture(scope="module")
def briefly(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """The first five rests: enough to be spoilt."""
    mast, (run,) = recorded_of(tmp_path_factory.mktemp("brief"), RESTS[:5])
    return Recorded(mast, run, run)


def pictures_of(run: Path) -> list[tuple[float, float, np.ndarray]]:
    """The pictures of a run: pan, tilt, image."""
    return [(one.pan_rad, one.tilt_rad, one.frames[CAMERA].image()) for one in read_recording(run)]


@pytest.fixture(scope="module")
def pictures(recorded: Recorded) -> list[tuple[float, float, np.ndarray]]:
    """The pictures of the whole look."""
    return pictures_of(recorded.run)


def refined(recorded: Recorded, record: Path, out: Path, mast: Path | None = None) -> int:
    given = ["calibrate", str(mast or recorded.mast), "--refine-scene", str(record), "--out", str(out)]
    return main([*given, "--json"])


def check_truth(told: dict[str, Any]) -> None:
    """The turn is as it truly is, and nothing else is corrected."""
    assert told["corrected"] == ["navcam turned in the head"]
    off = (np.array(told["values"]) - TURN_RAD) / np.array(told["sigma"])
    assert np.abs(off).max() < 4.0
    assert max(told["sigma"]) < 4e-4
    assert told["rms_px"]["after"] < 0.5 * told["rms_px"]["before"]


@pytest.mark.long(
    3, "a whole run is recorded and refined; test_cli_refine_scene.py asks the same of stored pictures"
)
def test_a_recorded_run_tells_how_the_camera_is_turned_and_predicts_pictures_of_other_rests(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    believed = load_rig(recorded.mast).rig
    renamed = save_rig(replace(believed, name="renamed"), tmp_path / "renamed.yaml")
    assert refined(recorded, recorded.run, tmp_path / "new.yaml", mast=renamed.path) == 0
    told = json.loads(capsys.readouterr().out)
    check_truth(told)
    assert told["pictures"] == told["other_mast"] == len(RESTS)  # of the file that was in use
    rig = load_rig(tmp_path / "new.yaml").rig
    assert rig.provenance["refined"][0]["former_digest"] == renamed.digest
    views = [
        SceneView(f"{at}", CAMERA, grey(one.frames[CAMERA].image()), one.pan_rad, one.tilt_rad, at)
        for at, one in enumerate(read_recording(recorded.other))
    ]
    features = find_features(believed, views)
    before, after = (np.median(left_px(one, views, features)) for one in (believed, rig))
    assert after < 0.5 * before


def as_folder(pictures: list[tuple[float, float, np.ndarray]], folder: Path, camera: str = CAMERA) -> Path:
    """The pictures as PNG files beside their frames.csv."""
    folder.mkdir()
    with (folder / "frames.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["camera", "pan_rad", "tilt_rad", "file"])
        for at, (pan, tilt, image) in enumerate(pictures):
            cv2.imwrite(str(folder / f"{at}.png"), image)
            rows.writerow([camera, pan, tilt, f"{at}.png"])
    return folder


@pytest.mark.long(3, "needs the recorded run of the test above")
def test_a_folder_of_pictures_with_their_angles_tells_the_same(
    recorded: Recorded,
    pictures: list[tuple[float, float, np.ndarray]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert refined(recorded, as_folder(pictures, tmp_path / "frames"), tmp_path / "new.yaml") == 0
    check_truth(json.loads(capsys.readouterr().out))


@pytest.mark.long(3, "needs the recorded run of the test above")
def test_a_joint_that_slipped_half_way_is_named_and_nothing_is_written(
    recorded: Recorded,
    pictures: list[tuple[float, float, np.ndarray]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    slipped = [
        (pan - (0.006 if at >= 5 else 0.0), tilt, image) for at, (pan, tilt, image) in enumerate(pictures)
    ]
    assert refined(recorded, as_folder(slipped, tmp_path / "frames"), tmp_path / "new.yaml") == 1
    error = json.loads(capsys.readouterr().out)["error"]
    assert error["code"] == "changed_halfway"
    assert "between the rest at pan" in error["message"] and "one side alone" in error["message"]
    assert not (tmp_path / "new.yaml").exists()


Spoil = Callable[[Recorded, list[tuple[float, float, np.ndarray]], Path], Path]


def one_picture(_: Recorded, pictures: list[tuple[float, float, np.ndarray]], folder: Path) -> Path:
    return as_folder(pictures[:1], folder / "f")


def far_apart(_: Recorded, pictures: list[tuple[float, float, np.ndarray]], folder: Path) -> Path:
    return as_folder([pictures[0], pictures[4]], folder / "f")


def blank_sky(_: Recorded, pictures: list[tuple[float, float, np.ndarray]], folder: Path) -> Path:
    return as_folder([(p, t, np.full_like(image, 180)) for p, t, image in pictures], folder / "f")


def other_names(_: Recorded, pictures: list[tuple[float, float, np.ndarray]], folder: Path) -> Path:
    return as_folder(pictures[:3], folder / "f", "pancam_left")


def cut_off(recorded: Recorded, _: list[tuple[float, float, np.ndarray]], folder: Path) -> Path:
    shutil.copy(recorded.run, folder / "run.mcap")
    with (folder / "run.mcap").open("r+b") as file:
        file.truncate(3000)
    return folder / "run.mcap"


def torn_picture(_: Recorded, pictures: list[tuple[float, float, np.ndarray]], folder: Path) -> Path:
    frames = as_folder(pictures[:3], folder / "f")
    (frames / "1.png").write_bytes((frames / "1.png").read_bytes()[:500])
    return frames


@pytest.mark.parametrize(
    ("spoil", "status", "phrase"),
    [
        (one_picture, 1, "1 pictures of navcam in a record of navcam; two at least are expected"),
        (far_apart, 1, "no two of 2 pictures overlap"),
        (blank_sky, 1, "0 features are in two pictures or more where 12 are expected"),
        (other_names, 1, "0 pictures of navcam in a record of pancam_left"),
        (cut_off, 2, "run.mcap"),
        (torn_picture, 2, "1.png"),
    ],
)
def test_a_record_that_cannot_tell_anything_is_refused_in_one_sentence(
    spoil: Spoil,
    status: int,
    phrase: str,
    briefly: Recorded,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    record = spoil(briefly, pictures_of(briefly.run), tmp_path)
    assert refined(briefly, record, tmp_path / "new.yaml") == status
    message = json.loads(capsys.readouterr().out)["error"]["message"]
    assert phrase in message and "\n" not in message
    assert not (tmp_path / "new.yaml").exists()
