"""Stated uncertainty against scatter, open directions in words, and what a fitted file is good for."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calib.adjust.result import Calibration
from calib.adjust.uncertainty import _reason, pixel_covariance, pointing_covariance
from calib.calibrate.paper import fit_paper
from calib.calibrate.survey import fit_joint
from calib.geometry.covariance import moved_rig, pixel_rates
from calib.geometry.pointing import solve
from calib.geometry.rig import Rig
from calib.geometry.stereo import triangulate
from calib.survey.records import Click
from hil_tests.calib.adjust.small_surveys import held, rings, survey_of
from hil_tests.support.sim_survey.plan import SurveyPlan
from hil_tests.support.sim_survey.survey import simulate_survey

SURVEYS = 16
SMALL = SurveyPlan(rings=rings(2), mast_boards=5, check_boards=0)
CHI_SQUARE_OFF = 4.0
"""Standard deviations that a mean over surveys may be off."""

POINTING_PX, CLICK_PX = 0.3, 0.2


@pytest.fixture(scope="module")
def fits(navcams: Rig) -> list[Calibration]:
    """Small surveys of the Navcams."""
    return [fit_joint(survey_of(navcams, 100 + seed, SMALL)) for seed in range(SURVEYS)]


SCATTER = pytest.mark.long(1, "a scatter of many fits; one fit beside its covariance is in the quick run")


@SCATTER
def test_stated_sigmas_are_the_scatter(fits: list[Calibration], true_rig: Rig) -> None:
    truth = np.array([*true_rig.mast.translation_m, *true_rig.mast.rotation_rad])
    errors = np.array([f.estimate[:6] - truth for f in fits])
    whitened = [
        float(e @ np.linalg.solve(f.covariance[:6, :6], e)) for e, f in zip(errors, fits, strict=True)
    ]
    off = (np.mean(whitened) - 6) / np.sqrt(2 * 6 / SURVEYS)
    assert abs(off) < CHI_SQUARE_OFF, f"mean of squares {np.mean(whitened):.2f} where 6 is expected"


@SCATTER
def test_predicted_pixels_scatter_as_stated(fits: list[Calibration], true_rig: Rig) -> None:
    squares = []
    for fit in fits:
        rays = true_rig.camera_in_rover("navcam_left", 0.5, -0.4).ray([(500.0, 400.0)])
        point = rays.origins_m + 4.0 * rays.directions
        predicted, covariance = pixel_covariance(fit, "navcam_left", 0.5, -0.4, point)
        error = predicted[0] - [500.0, 400.0]
        squares.append(float(error @ np.linalg.solve(covariance[0], error)))
    off = (np.mean(squares) - 2) / np.sqrt(2 * 2 / SURVEYS)
    assert abs(off) < CHI_SQUARE_OFF, f"mean of squares {np.mean(squares):.2f} where 2 is expected"


@SCATTER
def test_weighted_sum_of_squares_is_chi_square(fits: list[Calibration]) -> None:
    off = [(f.chi2 - f.degrees_of_freedom) / np.sqrt(2 * f.degrees_of_freedom) for f in fits]
    assert abs(np.mean(off)) * np.sqrt(SURVEYS) < CHI_SQUARE_OFF
    assert 0.5 < np.std(off) < 1.6
    assert np.mean([len(f.outliers) for f in fits]) < 0.3


@pytest.mark.long(4, "a scatter of twelve fits; each sigma is compared with a second fit in the quick run")
def test_the_papers_sigmas_hold_its_scatter(navcams: Rig) -> None:
    truth = np.array([*navcams.mast.translation_m, *navcams.mast.rotation_rad])
    squares = []
    for seed in range(12):
        fit = fit_paper(survey_of(navcams, 300 + seed, SMALL))
        error = fit.estimate[:6] - truth
        squares.append(float(error @ np.linalg.solve(fit.covariance[:6, :6], error)))
    off = (np.mean(squares) - 6) / np.sqrt(2 * 6 / 12)
    assert abs(off) < CHI_SQUARE_OFF, f"mean of squares {np.mean(squares):.2f} where 6 is expected"


def test_pixel_rates_are_those_of_differences(joint: Calibration) -> None:
    points = np.array([[4.0, 0.5, -0.5], [6.0, 1.0, 0.0]])
    for camera in ("navcam_left", "hazcam_right"):
        rates = pixel_rates(joint.rig, joint.parameter_names, camera, 0.2, -0.3, points).to_rig
        for column, name in enumerate(joint.parameter_names):
            step = np.zeros(len(joint.parameter_names))
            step[column] = 1e-3 if name.split(".")[2][0] in "HV" else 1e-6
            ends = [
                moved_rig(joint.rig, joint.parameter_names, s * step)
                .camera_in_rover(camera, 0.2, -0.3)
                .project(points)[0]
                for s in (1, -1)
            ]
            difference = (ends[0] - ends[1]) / (2 * step[column])
            scale = max(float(np.abs(difference).max()), 1.0)
            assert np.abs(rates[..., column] - difference).max() < 1e-4 * scale, name


@pytest.mark.parametrize(
    ("joint", "plan", "still"),
    [
        ("pan_rad", SurveyPlan(pan_rad=0.0), "pan hardly moved"),
        ("tilt_rad", SurveyPlan(tilt_rad=(-0.17, -0.2)), "tilt hardly moved"),
    ],
)
def test_a_joint_that_does_not_move_is_named(navcams: Rig, joint: str, plan: SurveyPlan, still: str) -> None:
    survey = held(simulate_survey(navcams, 2, plan), joint, 0.0 if joint == "pan_rad" else -0.17)
    for method in (fit_joint, fit_paper):
        fit = method(survey)
        assert fit.degenerate
        assert all("the survey does not fix" in d.sentence for d in fit.degenerate)
        assert any(still in d.sentence and "the mast's" in d.sentence for d in fit.degenerate)


def test_a_full_survey_leaves_nothing_open(joint: Calibration, paper: Calibration) -> None:
    assert joint.degenerate == () and paper.degenerate == ()


def test_check_images_are_predicted_and_never_fitted(joint: Calibration) -> None:
    checks = [i for i in joint.images if i.purpose == "check"]
    assert checks and not any(i.used.any() for i in checks)
    assert {i.camera for i in checks} == set(joint.check_rms_px)
    assert max(max(rms) for rms in joint.check_rms_px.values()) < 3.0


def test_a_check_click_that_its_camera_cannot_see_is_named(navcams: Rig) -> None:
    survey = survey_of(navcams, 100, SMALL)
    image = next(i for i in survey.images if i.camera == "navcam_left")
    behind = replace(survey.station[0], kind="check", setup=image.setup, point="brick")
    rover = fit_joint(survey).rover_from_station[image.setup]
    behind = replace(behind, position_m=rover.inverse.points(np.array([-50.0, 0.0, 0.0])))
    click = Click(image.name, "brick", np.array([10.0, 20.0]))
    fit = fit_joint(replace(survey, station=(*survey.station, behind), clicks=(click,)))
    assert fit.unseen_clicks == (click,)


def landed(true: Rig, fit: Calibration, seed: int, distance_m: float, count: int) -> np.ndarray:
    """Where ground targets truly land, pixels off the centre of the left Navcam, after one pointing."""
    rng = np.random.default_rng(seed)
    model = true.cameras["navcam_left"].model
    centre = np.array(model.image_center_px)
    errors: list[np.ndarray] = []
    while len(errors) < count:
        azimuth = rng.uniform(-1, 1)
        target = np.array([*true.mast.translation_m[:2], rng.normal(0, 0.1)])
        target += distance_m * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        first = solve(true.mast, model, target, centre + rng.uniform(-0.2, 0.2, 2) * model.size_px)[0]
        at = first.pan_rad, first.tilt_rad
        clicks, seen = [], True
        for name in ("navcam_left", "navcam_right"):
            pixel, valid = true.camera_in_rover(name, *at).project(target)
            seen &= bool(valid)
            clicks.append(pixel + rng.normal(0, CLICK_PX, 2))
        if not seen:
            continue
        left, right = (fit.rig.camera_in_rover(n, *at) for n in ("navcam_left", "navcam_right"))
        found = triangulate(left, right, *clicks)
        then = solve(fit.rig.mast, fit.rig.cameras["navcam_left"].model, found.position_m)[0]
        pixel, _ = true.camera_in_rover("navcam_left", then.pan_rad, then.tilt_rad).project(target)
        errors.append(pixel - centre)
    return np.array(errors)


@pytest.mark.parametrize("distance_m", [10.0, 6.0, 2.0])
def test_pointing_from_the_fitted_rig(joint: Calibration, true_rig: Rig, distance_m: float) -> None:
    rms = np.sqrt((landed(true_rig, joint, 7, distance_m, 60) ** 2).mean(axis=0))
    assert rms.max() < POINTING_PX


def test_stated_pointing_uncertainty_is_that_of_the_fit_alone(joint: Calibration) -> None:
    pair = ("navcam_left", "navcam_right")
    pixel = np.array([400.0, 300.0])
    alone = pointing_covariance(joint, pair, 0.3, -0.3, pixel, 4.0)
    assert 0 < np.sqrt(alone[0, 0]) < 0.1 and 0 < np.sqrt(alone[1, 1]) < 0.15


@pytest.mark.parametrize(
    ("name", "found"),
    [
        (
            "cameras.left.C.x",
            "C of left: camera left sees 2 boards; take more at two distances and over the whole image",
        ),
        (
            "mast.translation_m.x",
            "the mast's translation x; take more images of purpose mast, spread over pan and tilt",
        ),
    ],
)
def test_an_open_direction_is_named_with_what_would_fix_it(name: str, found: str) -> None:
    def image(camera: str, board: str, angle_rad: float, used: bool = True) -> Any:
        angles = {"pan_rad": angle_rad, "tilt_rad": angle_rad}
        return SimpleNamespace(camera=camera, board=board, attitude=0, keep=np.array([used]), **angles)

    images = [image("left", "b1", 0.0), image("left", "b2", 1.0), image("left", "b3", 2.0, used=False)]
    images += [image("right", f"b{number}", 0.5) for number in range(4)]
    problem: Any = SimpleNamespace(images=images)
    assert _reason(problem, [name]) == f"the survey does not fix {found}"
