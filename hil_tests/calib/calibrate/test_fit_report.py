"""What a fit tells of each image: how far its board was, what remains of its dots, why it was left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.adjust.result import Calibration
from calib.adjust.robust import SurveyNotFitted
from calib.calibrate.paper import fit_paper
from calib.calibrate.starts.survey import start_values
from calib.calibrate.survey import fit_joint
from calib.geometry.rig import Rig
from calib.survey.records import Sigma, Survey
from hil_tests.calib.adjust.small_surveys import rings, survey_of, with_shifted_dots
from hil_tests.support.sim_survey.plan import SurveyPlan, rover_from_head

SMALL = SurveyPlan(rings=rings(2), mast_boards=5, check_boards=1)
NEAR_M, NEAR_RAD = 0.01, 0.02
"""What tapes and prisms of a millimetre leave open."""

NOISE_PX = 0.15
"""Dots have a sigma of 0.1 px."""


@pytest.fixture(scope="module")
def survey(navcams: Rig) -> Survey:
    return survey_of(navcams, 21, SMALL)


@pytest.fixture(scope="module")
def fitted(survey: Survey) -> Calibration:
    return fit_joint(survey)


def board_in_rover(survey: Survey, setup: str, placement: str) -> tuple[np.ndarray, np.ndarray]:
    """The middle of a board (3,) metres and its normal, from prisms and tapes by SciPy's alignment."""
    prisms = {p.point: p.position_m for p in survey.station if p.kind == "prism" and p.setup == setup}
    there = np.array([survey.prisms_in_rover_m[name] for name in prisms])
    here = np.array(list(prisms.values()))
    turn, _ = Rotation.align_vectors(there - there.mean(axis=0), here - here.mean(axis=0))
    a, b, c = (
        turn.apply(p.position_m - here.mean(axis=0)) + there.mean(axis=0)
        for name in "abc"
        for p in survey.station
        if p.kind == "tape" and (p.setup, p.placement, p.point) == (setup, placement, name)
    )
    normal = np.cross(b - a, c - a)
    return (b + c) / 2, normal / np.linalg.norm(normal)


def test_range_and_lean_of_a_board_are_those_from_where_the_camera_stood(
    survey: Survey, fitted: Calibration, navcams: Rig
) -> None:
    assert len(fitted.images) == len(survey.images)
    for image in fitted.images:
        assert image.pan_rad is not None and image.tilt_rad is not None
        head = rover_from_head(navcams.mast, image.pan_rad, image.tilt_rad)
        eye = head.points(navcams.cameras[image.camera].model.C)
        middle, normal = board_in_rover(survey, image.setup, image.placement)
        away = middle - eye
        lean = np.arccos(abs(normal @ away) / np.linalg.norm(away))
        assert image.range_m == pytest.approx(np.linalg.norm(away), abs=NEAR_M), image.name
        assert image.incidence_rad == pytest.approx(lean, abs=NEAR_RAD), image.name


def test_sigmas_of_the_mast_file_are_the_roots_of_the_covariance(fitted: Calibration) -> None:
    sigma = dict(zip(fitted.parameter_names, np.sqrt(np.diag(fitted.covariance)), strict=True))
    for key in ("translation_m", "rotation_rad"):
        assert fitted.sigma["mast"][key] == pytest.approx([sigma[f"mast.{key}.{axis}"] for axis in "xyz"])
    for name, camera in fitted.sigma["cameras"].items():
        for letter in "CHV":
            wanted = [sigma[f"cameras.{name}.{letter}.{axis}"] for axis in "xyz"]
            assert camera[letter] == pytest.approx(wanted)


def test_fitted_images_have_the_angles_as_fitted_and_checks_as_read(navcams: Rig) -> None:
    """Joints that are 2 mrad off move a Navcam's dots by some 2.5 px."""
    fit = fit_joint(survey_of(navcams, 22, SMALL, rings=rings(4), sigma=Sigma(0.001, 0.1, joint_rad=0.002)))
    head = [i for i in fit.images if i.used.any()]
    checks = [i for i in fit.images if i.purpose == "check"]
    assert np.sqrt(np.mean([np.mean(i.residuals_px**2) for i in head])) < NOISE_PX
    assert np.sqrt(np.mean([np.mean(i.residuals_px**2) for i in checks])) > 3 * NOISE_PX


def test_where_everything_is_twice_as_noisy_as_stated_nothing_is_an_outlier(navcams: Rig) -> None:
    survey = survey_of(navcams, 23, SMALL, sigma=Sigma(0.002, 0.2))
    fit = fit_joint(replace(survey, sigma=Sigma(0.001, 0.1)))
    assert fit.outliers == ()


def test_the_papers_fit_states_how_far_off_a_left_out_image_was(navcams: Rig) -> None:
    survey = survey_of(navcams, 24, SMALL)
    name = next(i.name for i in survey.images if i.purpose == "mast")
    (outlier,) = fit_paper(with_shifted_dots(survey, name, (30.0, 0.0))).outliers
    assert outlier.name == f"image {name}"
    assert outlier.size == pytest.approx(30.0, abs=1.0)


def test_a_camera_without_dots_is_left_out_and_one_without_camera_images_refused(survey: Survey) -> None:
    right = {i.name for i in survey.images if i.camera == "navcam_right"}
    blind = replace(survey, dots={n: d for n, d in survey.dots.items() if n not in right})
    start = start_values(blind, 6)
    assert set(start.references.in_rover) == {"navcam_left"}
    assert "camera navcam_right has no image with dots and is not calibrated" in start.notes
    fitted = tuple(i for i in survey.images if i.name not in right or i.purpose != "camera")
    with pytest.raises(SurveyNotFitted, match="navcam_right"):
        start_values(replace(survey, images=fitted), 6, by_purpose=True)
