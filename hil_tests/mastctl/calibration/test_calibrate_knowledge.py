"""``mastctl calibrate`` with little known beforehand, and with too little measured to know the rest."""

from __future__ import annotations

import html
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.adjust.result import HELD_FIXED
from calib.files.mast_file import load_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Rig
from calib.survey.records import Sigma, SurveyImage
from hil_tests.calib.adjust.small_surveys import held
from hil_tests.mastctl.calibration.survey_world import edit_yaml, navcam_survey, write_folder
from mastctl.calibration.run import FITS, Method
from mastctl.cli.main import main
from mastctl.report import plots
from tools.sim_survey.plan import Ring, SurveyPlan
from tools.sim_survey.survey import simulate_survey

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


OTHER_WAY = pytest.mark.long(4, "the other method for each focal length; the quick run has each once")


@pytest.mark.parametrize(
    ("factor", "method"),
    [
        (0.8, "joint"),
        (1.2, "paper"),
        pytest.param(0.8, "paper", marks=OTHER_WAY),
        pytest.param(1.2, "joint", marks=OTHER_WAY),
    ],
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


@pytest.mark.parametrize("method", ["joint", "paper"])
@pytest.mark.parametrize(
    ("joint", "survey", "axis"),
    [
        # Were pan 0 always, the mast's y would be that of tilt; were tilt one, its z that of pan.
        ("pan", lambda: held(navcam_survey(2, pan_rad=0.0), "pan_rad", 0.0), "y"),
        ("tilt", lambda: held(navcam_survey(2, tilt_rad=(-0.17, -0.2)), "tilt_rad", -0.17), "z"),
    ],
    ids=["pan", "tilt"],
)
def test_a_joint_that_stands_still_is_named_with_what_it_leaves_open(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    joint: str,
    survey: Any,
    axis: str,
    method: str,
) -> None:
    monkeypatch.setattr(plots, "installed", lambda: False)  # the words are asked for
    write_folder(survey(), tmp_path / "s")
    report = ["--report", str(tmp_path / "r")] if method == "joint" else []
    told = calibrate(capsys, tmp_path, "--method", method, *report)
    assert told["verdict"]["grade"] == "bad"
    first = {direction["parameters"][0] for direction in told["degenerate"]}
    assert first == {f"mast.translation_m.{axis}", f"mast.rotation_rad.{axis}"}
    for direction in told["degenerate"]:
        assert f"{joint} hardly moved" in direction["sentence"]
        assert f"over the range of {joint} that will be used" in direction["sentence"]
    if report:
        page = html.unescape((tmp_path / "r" / "calibration.html").read_text())
        assert all(direction["sentence"] in page for direction in told["degenerate"])
    assert any(f"{joint} goes from" in warning for warning in told["warnings"])


@pytest.mark.parametrize("method", ["joint", "paper"])
def test_an_offset_of_a_joint_is_absorbed_as_it_is_told(
    method: Method,
) -> None:
    survey, _ = navcam_survey(1)
    plain = FITS[method](survey, 6)
    rig = plain.rig
    for joint in ("pan", "tilt"):
        assert any(f"an offset of {joint} is no parameter" in sentence for sentence in HELD_FIXED)
    # Both at once: each is absorbed on its own, by the mast and by the cameras.
    turned_by = {"pan_rad": 0.02, "tilt_rad": 0.03}

    def read(image: SurveyImage) -> SurveyImage:
        assert image.pan_rad is not None and image.tilt_rad is not None
        return replace(image, **{key: getattr(image, key) + by for key, by in turned_by.items()})

    offset = FITS[method](replace(survey, images=tuple(map(read, survey.images))), 6)
    other = offset.rig
    assert offset.chi2 == pytest.approx(plain.chi2, rel=1e-6)
    moved = other.mast.rotation_rad - rig.mast.rotation_rad
    np.testing.assert_allclose(moved, [0.0, 0.0, -0.02], atol=1e-6)
    for name in rig.cameras:
        # Same joint, same camera, though its reading is another.
        here = rig.camera_in_rover(name, 0.3, -0.4)
        there = other.camera_in_rover(name, 0.3 + turned_by["pan_rad"], -0.4 + turned_by["tilt_rad"])
        rays = here.ray(np.array([[100.0, 100.0], [900.0, 300.0], [500.0, 700.0]]))
        points = rays.origins_m + 5.0 * rays.directions
        np.testing.assert_allclose(there.project(points)[0], here.project(points)[0], atol=1e-3)


def test_the_papers_method_is_warned_of_camera_images_at_one_distance(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plots, "installed", lambda: False)
    write_folder(navcam_survey(2, rings=(Ring("navcam", 4.0, 8, -0.17),))[0], tmp_path / "s")
    assert calibrate(capsys, tmp_path)["warnings"] == [], "the joint fit has the boards of the mast as well"
    told = calibrate(capsys, tmp_path, "--method", "paper", "--report", str(tmp_path / "r"))
    assert told["verdict"]["grade"] != "good"
    page = html.unescape((tmp_path / "r" / "calibration.html").read_text())
    for name in ("navcam_left", "navcam_right"):
        [warning] = [w for w in told["warnings"] if name in w]
        assert "all its boards stand between" in warning and "can trade for each other" in warning
        assert warning in page


# Prisms that the drawing knows roughly


def test_prisms_of_a_rough_drawing_are_refined_over_two_set_ups(
    repository: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    true = three_kinds(repository)
    plan = SurveyPlan(sigma=Sigma(0.001, 0.1, 0.0, 0.003))
    survey, _ = simulate_survey(true, 6, plan)
    assert len({p.setup for p in survey.station}) == 2
    write_folder(survey, tmp_path / "s")
    told = calibrate(capsys, tmp_path)
    assert told["verdict"]["grade"] == "good", told["verdict"]
    assert told["outliers"] == [] and told["chi2_probability"] > 0.001
    for key in ("translation_m", "rotation_rad"):
        error, sigma = np.array(told["mast"][key]) - getattr(true.mast, key), np.array(told["sigma"][key])
        assert (np.abs(error) < SIGMAS * sigma).all(), key
    refined = told["sigma"]["rotation_rad"]
    # The same drawing taken as exact does not agree with what the station saw from two places.
    edit_yaml(tmp_path / "s", lambda document: document["sigma"].update(prism_cad_m="0.0"))
    capsys.readouterr()
    code = main(["calibrate", str(tmp_path / "s"), "--out", str(tmp_path / "m.yaml"), "--json"])
    exact = json.loads(capsys.readouterr().out)
    assert code != 0 or exact["verdict"]["grade"] != "good" or exact["outliers"], exact
    if code == 0:
        assert all(np.array(exact["sigma"]["rotation_rad"]) < refined)
