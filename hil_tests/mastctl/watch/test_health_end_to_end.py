"""Calibration health through a whole daemon: a head whose true camera was bumped, and one as calibrated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.files.mast_file import load_rig, save_rig
from calib.geometry.rigid import Rigid, rot_z
from drivers.sim.heads import PRESETS
from mastctl.client import Client
from mastctl.config import Config, load_config
from mastctl.daemon import RunningDaemon
from mastctl.experiment.simulated import demo_config
from mastctl.experiment.targets import TargetViews
from mastctl.packaged import config_folder

BUMP_RAD = 2e-3
POINTINGS = 8
PAIR = ("navcam_left", "navcam_right")
PTU_COUNT_RAD = PRESETS["ptu_d46_70"].pan.count_rad


def config_of(folder: Path, bump_rad: float) -> Config:
    """The packaged rover, its true left Pancam turned about z of the head."""
    config = demo_config(load_config(None), head="ptu_d46_70", seed=3)
    true = load_rig(config_folder() / "sim" / "rocky8.yaml").rig
    camera = true.cameras["pancam_left"]
    turn = rot_z(bump_rad)
    place = camera.model.C
    bumped = camera.model.moved(Rigid(turn, place - turn @ place))
    cameras = {**true.cameras, "pancam_left": replace(camera, model=bumped)}
    save_rig(replace(true, cameras=cameras), folder / "true.yaml")
    simulation = {**config.hardware.simulation, "rover": str(folder / "true.yaml")}
    return replace(config, hardware=replace(config.hardware, simulation=simulation))


AS_CALIBRATED = pytest.mark.long(3, "the case of no bump; test_evidence.py has honest days quickly")


@pytest.mark.long(4, "days of pointings on two rendered rovers; the evidence is tested quickly on numbers")
@pytest.mark.parametrize(
    "bump_rad", [pytest.param(0.0, marks=AS_CALIBRATED), BUMP_RAD], ids=["as calibrated", "bumped"]
)
def test_a_bumped_camera_is_named_and_one_that_stands_is_not(tmp_path: Path, bump_rad: float) -> None:
    with RunningDaemon(config_of(tmp_path, bump_rad)) as daemon, Client(daemon.url) as client:
        said = []
        rig = daemon.service.stored.rig
        views = TargetViews(client, rig, PAIR, client.status()["limits"], np.random.default_rng(3), 1.0)
        aim = ("pancam_left", *rig.cameras["pancam_left"].model.image_center_px)
        for number in range(POINTINGS):
            target = next(one for _ in range(12) if (one := views.find_target(6.0)) is not None)
            clicked = (PAIR[0], target.shot.frame_id, target.x_px, target.y_px)
            client.wait(client.point(pixel=clicked, aim=aim))
            health = client.calibration_health()
            said.append(health["verdict"])
            if bump_rad and said[-1] == "drifts":
                break
            if not bump_rad and number == POINTINGS // 2:
                break
    newest = health["newest"][0]
    assert newest["count_rad"] == pytest.approx([PTU_COUNT_RAD] * 2), "the head told its own count"
    if not bump_rad:
        assert "drifts" not in said and health["pointings"] >= 3
        return
    assert said[-1] == "drifts", said
    assert "pancam_left" in health["sentence"]
    turn = np.array(health["cameras"]["pancam_left"]["turn_rad"])
    sigma = np.array(health["cameras"]["pancam_left"]["sigma_rad"])
    assert abs(turn[2] - BUMP_RAD) < 4.0 * sigma[2] + 2e-4
