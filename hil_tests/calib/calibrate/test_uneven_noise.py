"""Noise that differs by camera and by picture is no blunder; what is one is named by a tested cause."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from calib.adjust.robust import SurveyNotFitted
from calib.calibrate.bench import fit_bench
from calib.calibrate.survey import fit_joint
from calib.survey.check import check_survey
from calib.survey.records import Sigma, Survey
from hil_tests.calib.adjust.small_surveys import with_shifted_dots
from hil_tests.mastctl.calibration.survey_world import navcam_rig
from hil_tests.support.sim_survey.bench import BenchPlan, simulate_bench
from hil_tests.support.sim_survey.blunders import with_changed_focus, with_moved_tape, with_slipped_joint
from hil_tests.support.sim_survey.noise import with_noise
from hil_tests.support.sim_survey.plan import SurveyPlan
from hil_tests.support.sim_survey.survey import simulate_survey
from mastctl.calibration.verdict import judge

FACTOR_WITHIN = 0.1


def navcams(seed: int, plan: SurveyPlan | None = None) -> Survey:
    """The survey of the Navcams alone."""
    return simulate_survey(navcam_rig(), seed, plan)[0]


@pytest.mark.parametrize("times", [1.3, 5.0])
def test_a_camera_noisier_than_stated_loses_no_image(times: float) -> None:
    survey = navcams(1)
    noisy = [image.name for image in survey.images if image.camera == "navcam_left"]
    fit = fit_joint(with_noise(survey, dict.fromkeys(noisy, times), np.random.default_rng(1)))
    assert not [o.name for o in fit.outliers if o.kind == "image"]
    (found,) = [c.factor for c in fit.components if c.kind == "dots of navcam_left"]
    assert found == pytest.approx(times, rel=FACTOR_WITHIN)
    (other,) = [c.weighed for c in fit.components if c.kind == "dots of navcam_right"]
    assert other == 1.0


def test_a_placement_with_a_little_more_noise_contradicts_nothing() -> None:
    survey = navcams(2)
    noisy = [i.name for i in survey.images if (i.setup, i.placement) == ("level", "navcam-3m-2")]
    fit = fit_joint(with_noise(survey, dict.fromkeys(noisy, 1.15), np.random.default_rng(1)))
    (found,) = [one for one in fit.contradictions if one.subject == ("board", "level", "navcam-3m-2")]
    assert found.chance > 1e-3


@pytest.mark.parametrize("what", ["picture", "placement"])
def test_noisy_pictures_of_a_bench_count_with_their_own_sigma(what: str) -> None:
    survey = simulate_bench(1, BenchPlan(attitudes=7, own_px=0.02))
    noisy = [i.name for i in survey.images if i.placement == "p2"][: None if what == "placement" else 1]
    fit = fit_bench(with_noise(survey, dict.fromkeys(noisy, 3.0), np.random.default_rng(1)))
    assert not [o.name for o in fit.outliers if o.kind == "image"]
    weighed = {c.kind: c.weighed for c in fit.components}
    times = {i.name: i.scatter * weighed[f"dots of {i.camera}"] for i in fit.images}
    assert np.median([times[name] for name in noisy]) == pytest.approx(3.0, rel=2 * FACTOR_WITHIN)
    assert np.median([t for name, t in times.items() if name not in noisy]) == pytest.approx(1.0, abs=0.05)


def test_a_print_that_is_right_is_not_blamed_for_noise() -> None:
    survey = simulate_bench(1, BenchPlan(attitudes=7, own_px=0.02))
    every = dict.fromkeys([image.name for image in survey.images], 2.0)
    assert fit_bench(with_noise(survey, every, np.random.default_rng(1))).inexact_m == 0.0


def test_a_camera_knocked_by_less_than_a_pixel_is_named() -> None:
    survey = navcams(3)
    later = [i.name for i in survey.images if i.camera == "navcam_left"][7:]
    dots = {
        name: replace(seen, pixels_px=seen.pixels_px + np.array([0.5, 0.5])) if name in later else seen
        for name, seen in survey.dots.items()
    }
    survey = replace(survey, dots=dots)
    verdict = judge(survey, fit_joint(survey))
    assert verdict.grade != "good"
    said = [reason.sentence for reason in verdict.reasons]
    assert any(
        re.search(r"navcam_left was knocked between pictures \S+ and \S+, and turned", one) for one in said
    )


def test_a_refusal_names_the_camera_that_was_refocused() -> None:
    survey = navcams(7)
    first = [i.name for i in survey.images if i.camera == "navcam_right" and i.purpose != "check"][6]
    survey = with_changed_focus(survey, "navcam_right", first, 1.01)
    try:
        said = [r.sentence for r in judge(survey, fit_joint(survey)).reasons if r.grade != "good"]
    except SurveyNotFitted as refused:
        said = [str(refused)]
    assert any("on navcam_right is another camera (focal length" in sentence for sentence in said)


@pytest.mark.parametrize("joint", ["pan", "tilt"])
def test_a_slip_that_only_tapes_show_is_named_with_its_place_and_size(joint: str) -> None:
    survey = navcams(2, SurveyPlan(mast_boards=6))
    first = next(i.name for i in survey.images if i.placement == "mast-4")
    try:
        wider = fit_joint(with_slipped_joint(survey, joint, first, 0.01)).wider
        (said,) = [w.sentence for w in wider if w.name == f"images left out for a change of {joint}"]
    except SurveyNotFitted as refused:
        said = str(refused)
    found = re.search(rf"{joint} slipped by about ([0-9.]+) mrad between pictures \S+ and (\S+):", said)
    assert found is not None and found[2] == first
    assert float(found[1]) == pytest.approx(10.0, rel=2 * FACTOR_WITHIN)


@pytest.mark.parametrize(
    ("aside_m", "shift_px"), [((0.03, 0.02, -0.02), (-3, 2)), ((0.02, -0.03, 0.02), (3, 2))]
)
def test_a_wrong_tape_beside_a_wrong_picture_costs_no_good_one(
    aside_m: tuple[float, float, float], shift_px: tuple[float, float]
) -> None:
    survey = with_shifted_dots(navcams(3, SurveyPlan(mast_boards=6)), "navcam_left-021", shift_px)
    fit = fit_joint(with_moved_tape(survey, "level", "mast-3", "b", aside_m))
    left_out = {o.name for o in fit.outliers if o.kind != "dot"}
    assert left_out == {"image navcam_left-021", "tape b of placement mast-3 (set-up level)"}


def test_a_station_three_times_worse_than_stated_passes_the_check() -> None:
    for seed in range(1, 9):
        survey = navcams(seed, SurveyPlan(sigma=Sigma(0.003, 0.1)))
        findings = check_survey(replace(survey, sigma=Sigma(0.001, 0.1)))
        assert not [str(finding) for finding in findings if finding.severity == "error"]
