"""``mastctl calibrate`` with little known beforehand, and with too little measured to know the rest."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.files.mast_file import load_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Rig
from hil_tests.mastctl.calibration.survey_world import edit_yaml, write_folder
from hil_tests.support.sim_survey.plan import SurveyPlan
from hil_tests.support.sim_survey.survey import simulate_survey
from mastctl.cli.main import main

SIGMAS = 4.5
"""How many stated sigmas the truth may be off in one seeded survey."""


def calibrate(capsys: pytest.CaptureFixture[str], folder: Path, *words: str) -> dict[str, Any]:
    """Run the command with --json on ``folder/s``; the mast file is ``folder/m.yaml``."""
    capsys.readouterr()
    assert main(["calibrate", str(folder / "s"), "--out", str(folder / "m.yaml"), "--json", *words]) == 0
    return dict(json.loads(capsys.readouterr().out))


# Only a rough focal length is known; one rig with all three kinds of camera


def three_kinds(repository: Path) -> Rig:
    """Navcams and Hazcams of the true rig, the left Navcam without a lens: CAHV, CAHVOR and CAHVORE."""
    rig = load_rig(repository / "configs" / "sim" / "rocky8.yaml").rig
    cameras = {name: camera for name, camera in rig.cameras.items() if not name.startswith("pancam")}
    left = cameras["navcam_left"]
    m = left.model
    cameras["navcam_left"] = replace(left, model=CameraModel("CAHV", m.size_px, m.C, m.A, m.H, m.V))
    return replace(rig, cameras=cameras, stereo={pair: rig.stereo[pair] for pair in ("navcam", "hazcam")})


@pytest.mark.parametrize(
    ("factor", "method"),
    [(0.8, "joint"), (1.2, "paper")],
)
def test_cameras_of_every_kind_are_fitted_from_a_rough_focal_length_alone(
    repository: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], factor: float, method: str
) -> None:
    true = three_kinds(repository)
    write_folder(simulate_survey(true, 4, SurveyPlan(rough=False))[0], tmp_path / "s")

    def rough(document: dict[str, Any]) -> None:
        for name, camera in document["cameras"].items():
            model = true.cameras[name].model
            assert "rough" not in camera
            camera["focal_px"] = str(factor * float(np.linalg.norm(np.cross(model.A, model.H))))

    edit_yaml(tmp_path / "s", rough)
    told = calibrate(capsys, tmp_path, "--method", method)
    assert told["verdict"]["grade"] == "good", told["verdict"]
    fitted = load_rig(tmp_path / "m.yaml").rig
    kinds = {"navcam_left": "CAHV", "navcam_right": "CAHVOR", "hazcam_left": "CAHVORE"}
    assert {name: fitted.cameras[name].model.kind for name in kinds} == kinds
    for name, camera in fitted.cameras.items():
        assert camera.model.R[0] == 0.0, "R0 is a gauge"
        assert told["sigma"]["cameras"][name].get("R", [0.0])[0] == 0.0
        assert not any(p.startswith(f"cameras.{name}.R.0") for p in fitted.fit["parameters"])
    for key in ("translation_m", "rotation_rad"):
        error = np.array(told["mast"][key]) - getattr(true.mast, key)
        assert (np.abs(error) < SIGMAS * np.array(told["sigma"][key])).all(), key


# What a survey leaves open is named, in the document and in the report


# Prisms that the drawing knows roughly
