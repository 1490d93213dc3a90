"""A simulated camera that reads a part of its sensor: refused, carried over by the command, and pointed."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.files.mast_file import load_rig, save_rig
from calib.geometry.sensor_mode import SensorMode
from drivers.errors import BadFrame
from mastctl.cli.main import main
from mastctl.client import Client
from mastctl.config import Config, Listen, load_config
from mastctl.daemon import RunningDaemon
from mastctl.devices.frames import camera_and_sequence
from mastctl.packaged import config_folder

WHOLE = SensorMode((1024, 768), (0, 0, 1024, 768), (1024, 768))


def daemon_of(mast_file: Path, mode: dict[str, Any]) -> Config:
    """The packaged rover of one camera, with a mast file and a mode of its sensor."""
    config = load_config(config_folder() / "one_camera.yaml")
    simulation = {**config.hardware.simulation, "speed": "max", "sensor_modes": {"navcam": mode}}
    hardware = replace(config.hardware, simulation=simulation)
    return replace(config, mast_file=mast_file, listen=Listen(port=0), hardware=hardware)


@pytest.mark.parametrize(
    ("mode", "click"),
    [
        ({"crop_px": [112, 84, 800, 600], "binning": [2, 2], "flip": "both"}, (290.0, 82.0)),
        ({"crop_px": [100, 40, 800, 600]}, (230.0, 480.0)),
    ],
    ids=["middle, binned and flipped", "off the middle"],
)
def test_another_mode_is_refused_and_points_with_the_mast_file_that_the_command_told_writes(
    mode: dict[str, Any], click: tuple[float, float], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = load_rig(config_folder() / "masts" / "one_camera_simulated.yaml").rig
    known = replace(rig.cameras["navcam"], sensor_mode=WHOLE)
    old, new = tmp_path / "mast.yaml", tmp_path / "new.yaml"
    save_rig(replace(rig, cameras={"navcam": known}), old)
    with pytest.raises(BadFrame) as refused, RunningDaemon(daemon_of(old, mode)):
        pass
    told = re.search("'mastctl (camera mode .*?)' writes", str(refused.value))
    assert told, refused.value
    named = {"MAST.yaml": str(old), "NEW.yaml": str(new)}
    assert main([named.get(word, word) for word in shlex.split(told[1])] + ["--json"]) == 0
    json.loads(capsys.readouterr().out)

    with RunningDaemon(daemon_of(new, mode)) as daemon, Client(daemon.url) as client:
        client.wait(client.point(pan_rad=0.1, tilt_rad=-0.2))
        shot = client.snapshot("navcam")
        record = client.wait(client.point(pixel=("navcam", shot.frame_id, *click), pointings=2))
        assert record["state"] == "done", record["error"]
        rover = daemon.hardware.simulation
        assert rover is not None
        point = rover.true_point(*camera_and_sequence(shot.frame_id), click)
        assert point is not None
        last = record["pointings"][-1]
        true_px = rover.true_pixel(*camera_and_sequence(str(last["frame_id"])), point)
        assert np.abs(np.asarray(true_px) - last["aim_px"]).max() < 0.5
