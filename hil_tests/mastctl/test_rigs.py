"""configs/rigs: the drivers take each, and its mast points when only the devices are simulated."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from calib.files.mast_file import load_rig
from drivers.dynamixel.models import dynamixel_settings
from drivers.flir_ptu.axis import options_from as ptu_options
from drivers.v4l2.settings import parse_options
from mastctl.client import Client
from mastctl.config import load_config
from mastctl.daemon import RunningDaemon

RIGS = Path(__file__).resolve().parents[2] / "configs" / "rigs"
NAMES = sorted(one.stem for one in RIGS.glob("*.yaml") if not one.stem.endswith("_mast"))
HEADS: dict[str, Any] = {"dynamixel": dynamixel_settings, "flir_ptu": ptu_options}
STAND_INS = {"dynamixel": "dynamixel_x", "flir_ptu": "ptu_d46_70"}


def written(name: str) -> dict[str, Any]:
    document: dict[str, Any] = yaml.safe_load((RIGS / f"{name}.yaml").read_text())
    return document


@pytest.mark.parametrize("name", NAMES)
def test_the_drivers_take_its_options_and_its_soft_limits_lie_within(name: str) -> None:
    config, document = load_config(RIGS / f"{name}.yaml"), written(name)
    head = document["pan_tilt"]
    HEADS[head["driver"]](head["options"])
    for key, camera in document["cameras"].items():
        assert camera["driver"] == "v4l2"
        parse_options(camera["options"], key)
    for axis in ("pan", "tilt"):
        low, high = head["options"][axis]["limits_rad"]
        soft_low, soft_high = document["limits"][f"{axis}_rad"]
        assert low < soft_low < soft_high < high
    cameras = load_rig(config.mast_file).rig.cameras
    sizes = {name: tuple(camera.model.size_px) for name, camera in cameras.items()}
    assert {key: tuple(one["options"]["size_px"]) for key, one in document["cameras"].items()} == sizes


@pytest.mark.parametrize("name", NAMES)
def test_its_mast_points_when_only_the_devices_are_simulated(name: str, tmp_path: Path) -> None:
    document = written(name)
    shutil.copy(RIGS / document["mast_file"], tmp_path)
    head = STAND_INS[document["pan_tilt"]["driver"]]
    document |= {
        "listen": {"port": 0},
        "pan_tilt": {"driver": "sim"},
        "cameras": {key: {"driver": "sim"} for key in document["cameras"]},
        "state": {"folder": str(tmp_path / "state")},
        "record": {"ring_s": 0, "folder": str(tmp_path / "records")},
        "simulation": {"rover": document["mast_file"], "head": head, "samples": 1, "speed": "max"},
    }
    document.get("tracking", {}).pop("handoff_log", None)
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(document))
    camera = next(iter(document["cameras"]))
    with RunningDaemon(load_config(tmp_path / "config.yaml")) as daemon, Client(daemon.url) as mast:
        done = mast.wait(mast.point(position_m=(3.0, 0.3, 0.0), aim=(camera, 300.0, 240.0)))
        assert done["state"] == "done", done["error"]
        assert done["steps"]
