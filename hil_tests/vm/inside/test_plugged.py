"""`mastctl rig new` finds the kernel's cameras, and its configuration opens both."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path

import pytest

from calib.files.mast_file import load_rig
from drivers.v4l2.camera import open_camera
from mastctl.cli.main import main
from mastctl.config import load_config
from mastctl.setup import doctor

from .conftest import BUS


def test_the_cameras_are_found_and_opened_by_what_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "rig"
    assert main(["rig", "new", str(folder), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert len(told["cameras"]) == 2 and told["heads"] == []
    config = load_config(folder / "config.yaml")
    assert {camera.options["bus"] for camera in config.hardware.cameras.values()} == set(BUS)
    sizes = {name: camera.model.size_px for name, camera in load_rig(config.mast_file).rig.cameras.items()}
    for name, settings in config.hardware.cameras.items():
        with closing(open_camera(settings.options, name=name)) as camera:
            assert camera.info.size_px == sizes[name]
    findings = list(doctor.examine(str(folder / "config.yaml"), lambda url: None))
    assert {one.what for one in findings if one.level == "bad"} == {"port"}, "only the head is missing"
