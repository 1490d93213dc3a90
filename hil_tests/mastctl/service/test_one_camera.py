"""A head with one camera, as it is packaged: pointed by the daemon, held against the simulator's truth."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from calib.files.mast_file import load_rig
from mastctl.cli.main import main
from mastctl.client import Client, ClientError
from mastctl.config import Listen, load_config
from mastctl.daemon import RunningDaemon
from mastctl.devices.frames import camera_and_sequence
from mastctl.packaged import config_folder

CLICK = 330.0, 520.0


@pytest.fixture(scope="module")
def daemon() -> Iterator[RunningDaemon]:
    config = load_config(config_folder() / "one_camera.yaml")
    simulation = {**config.hardware.simulation, "speed": "max"}
    hardware = replace(config.hardware, simulation=simulation)
    with RunningDaemon(replace(config, listen=Listen(port=0), hardware=hardware)) as running:
        yield running


def off_px(daemon: RunningDaemon, clicked_id: str, row: dict[str, object]) -> np.ndarray:
    """The true residual of a pointing."""
    rover = daemon.hardware.simulation
    assert rover is not None
    point = rover.true_point(*camera_and_sequence(clicked_id), CLICK)
    assert point is not None
    return np.asarray(rover.true_pixel(*camera_and_sequence(str(row["frame_id"])), point) - row["aim_px"])


@pytest.mark.parametrize("told", [{"plane": {"point_m": [0.0, 0.0, 0.0]}}, {}])
def test_a_pixel_is_pointed_at_and_the_second_time_well(
    daemon: RunningDaemon, told: dict[str, object]
) -> None:
    with Client(daemon.url) as client:
        client.wait(client.point(pan_rad=0.1, tilt_rad=-0.2))
        shot = client.snapshot("navcam")
        record = client.wait(
            client.point(pixel=("navcam", shot.frame_id, *CLICK), pointings=2, **told)  # type: ignore[arg-type]
        )
    assert record["state"] == "done", record["error"]
    first, second = (off_px(daemon, shot.frame_id, row) for row in record["pointings"])
    for row, off in zip(record["pointings"], (first, second), strict=True):
        assert np.abs(np.array(row["residual_px"]) - off).max() < 0.2
        away = off + row["aim_px"] - row["predicted_px"]
        assert away @ np.linalg.solve(row["predicted_covariance_px2"], away) < 9.2
    assert np.abs(second).max() < 0.5
    assert record["range_from"] == ("plane" if told else "parallax")
    assert record["range_interval_m"][0] <= record["range_m"]
    kinds = [step["name"] for step in record["steps"]]
    assert kinds.count("range") == 2 and "stereo" not in kinds


def test_the_command_says_how_far_it_is(daemon: RunningDaemon, capsys: pytest.CaptureFixture[str]) -> None:
    at = ["--camera", "navcam", "--at", "500", "480", "--url", daemon.url, "--json"]
    assert main(["point", *at, "--range", "5"]) == 0
    assert json.loads(capsys.readouterr().out)["range_from"] == "given"
    assert main(["point", "--position", "5", "0", "0", "--ground", "0", "--url", daemon.url]) == 2
    assert "--range, --ground and --plane go with --pixel or --camera" in capsys.readouterr().err


def test_a_track_still_asks_for_the_other_eye(daemon: RunningDaemon) -> None:
    with Client(daemon.url) as client:
        shot = client.snapshot("navcam")
        with pytest.raises(ClientError) as refused:
            client.start_track(pixel=("navcam", shot.frame_id, *CLICK))
    assert refused.value.code == "no_stereo"


def test_a_range_without_a_pixel_is_bad_input(daemon: RunningDaemon) -> None:
    with Client(daemon.url) as client, pytest.raises(ClientError, match="range_m goes with pixel only"):
        client.point(position_m=(5.0, 0.0, 0.0), range_m=3.0)


def test_the_packaged_camera_is_the_left_navcam_of_the_packaged_rover() -> None:
    folder = config_folder()
    for one, whole in (
        ("masts/one_camera_simulated", "masts/rocky8_simulated"),
        ("sim/one_camera", "sim/rocky8"),
    ):
        alone, rig = load_rig(folder / f"{one}.yaml").rig, load_rig(folder / f"{whole}.yaml").rig
        mine, left = alone.cameras["navcam"].model, rig.cameras["navcam_left"].model
        assert list(alone.cameras) == ["navcam"] and not alone.stereo
        assert all(np.array_equal(getattr(mine, letter), getattr(left, letter)) for letter in mine.kind)
        assert np.array_equal(alone.mast.rotation_rad, rig.mast.rotation_rad)


def test_a_preview_tells_what_one_camera_knows_and_moves_nothing(daemon: RunningDaemon) -> None:
    with Client(daemon.url) as client:
        client.wait(client.point(pan_rad=0.1, tilt_rad=-0.2))
        shot, before = client.snapshot("navcam"), client.status()["joints"]
        clicked = ("navcam", shot.frame_id, *CLICK)
        unknown, level = client.preview(clicked), client.preview(clicked, plane={"point_m": (0.0, 0.0, 0.0)})
        after = client.status()["joints"]
    assert before is not None and after is not None and before["pan_rad"] == after["pan_rad"]
    assert unknown["range_from"] == "unknown" and unknown["range_interval_m"] == [pytest.approx(1.0), None]
    assert level["range_from"] == "plane" and abs(level["position_m"][2]) < 0.01
    assert unknown["other_camera"] is None and level["goal_rad"] is not None and level["refused"] is None
