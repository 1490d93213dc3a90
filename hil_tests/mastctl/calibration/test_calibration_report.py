"""The numbers of the report: predicted uncertainty against draws, check images against their expectation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.adjust.gross import Outlier
from calib.adjust.noise import Component
from calib.adjust.result import Calibration, Degenerate
from calib.adjust.robust import SurveyNotFitted
from calib.calibrate.paper import fit_paper
from calib.calibrate.survey import fit_joint
from calib.geometry.covariance import moved_rig
from calib.plan.knowledge import CLICKS
from calib.survey.records import Click, Survey, SurveyFinding
from hil_tests.mastctl.calibration.survey_world import navcam_rig, navcam_survey
from mastctl.calibration.landing import (
    click,
    expected_pointing,
    pointing_change,
    pointing_error_px,
)
from mastctl.calibration.run import FITS, calibrate
from mastctl.calibration.verdict import judge

DRAWS = 100
TURN_RAD = np.array([0.0, 0.0, 0.01])


@pytest.fixture(scope="module")
def fitted() -> tuple[Survey, Calibration]:
    survey, _ = navcam_survey(2)
    return survey, fit_joint(survey, 6)


def test_a_rig_that_is_believed_rightly_points_exactly() -> None:
    rig = navcam_rig()
    pair = rig.stereo["navcam"]
    target, left, right = click(rig, pair, 0.4, -0.3, [200.0, 600.0], 6.0)
    assert np.abs(pointing_error_px(rig, rig, pair, 0.4, -0.3, target, left, right)).max() < 1e-6


def test_the_uncertainty_of_pointing_is_the_spread_of_drawn_rigs(fitted: tuple[Survey, Calibration]) -> None:
    _, fit = fitted
    rig, pair = fit.rig, fit.rig.stereo["navcam"]
    expected = expected_pointing(fit)
    assert expected is not None
    landings, covariance = expected
    rng = np.random.default_rng(5)
    steps = rng.multivariate_normal(np.zeros(len(fit.covariance)), fit.covariance, DRAWS, method="eigh")
    drawn = [moved_rig(rig, fit.parameter_names, step) for step in steps]
    size, rates, errors = np.array(rig.cameras[pair[0]].model.size_px), [], []
    for k in range(0, len(landings.places), 13):  # of each place there is a click in each of four corners
        pan, tilt, range_m = landings.places[k]
        clicked = click(rig, pair, pan, tilt, size * CLICKS[k % 4], range_m)
        errors += [pointing_error_px(one, rig, pair, pan, tilt, *clicked) for one in drawn]
        rates.append(landings.to_rig[2 * k : 2 * k + 2])
    some = replace(landings, to_rig=np.concatenate(rates))
    spread = float(np.sqrt(np.mean(np.square(errors))))
    assert some.rms_px(covariance) == pytest.approx(spread, rel=0.2), "the spread of 200 numbers: 5 %"


def test_a_turned_mast_changes_pointing_at_positions_but_not_at_clicks() -> None:
    rig = navcam_rig()
    turned = replace(rig, mast=replace(rig.mast, rotation_rad=rig.mast.rotation_rad + TURN_RAD))
    change = pointing_change(rig, turned)["navcam"]
    # 10 mrad about the pan axis at a focal length of 1290 px, by the cosine of the elevation.
    assert change["position_most_px"] == pytest.approx(12.9, rel=0.05)
    assert 8.0 < change["position_median_px"] < 12.9
    assert change["most_px"] < 1e-3
    assert pointing_change(rig, replace(rig, cameras={}, stereo={})) == {}


def test_the_worst_reason_decides(fitted: tuple[Survey, Calibration]) -> None:
    survey, calibration = fitted
    assert judge(survey, calibration).grade == "good"
    assert judge(survey, calibration, undetected=["a"]).grade == "care"
    warning = SurveyFinding(
        "warning", "set-up level, placement mast-1", "its tapes are off", "Measure them again"
    )
    assert judge(survey, calibration, warnings=[warning]).grade == "care"
    tape = replace(warning, tested_again=True)  # as the fit did, and found nothing
    assert judge(survey, calibration, warnings=[tape]).grade == "good"
    exact = replace(calibration, chi2_probability=float("nan"))  # the paper's method takes tapes as exact
    assert judge(survey, exact, warnings=[tape]).grade == "care"
    unseen = replace(calibration, check_rms_px={})
    assert judge(survey, unseen).grade == "care"
    lost = Click("image7", "brick", np.array([10.0, 20.0]))
    blind = judge(survey, replace(calibration, unseen_clicks=(lost,)))
    assert blind.grade == "bad"
    assert any("image7 cannot show check point brick" in reason.sentence for reason in blind.reasons)
    prism = Outlier("prism", "prism p3 of set-up level", 0.02)
    care = judge(survey, replace(calibration, outliers=(prism,)))
    assert care.grade == "care"
    assert "prism p3" in care.reasons[-1].sentence
    left_open = Degenerate(("mast.translation_m.z",), "tilt hardly moved")
    open_survey = judge(survey, replace(calibration, degenerate=(left_open,)))
    assert open_survey.grade == "bad"
    assert not any("first pointing" in reason.sentence for reason in open_survey.reasons)
    noisy = replace(calibration, chi2=9.0 * calibration.degrees_of_freedom, chi2_probability=0.0)
    assert judge(survey, noisy).grade == "bad"
    off = {name: size._replace(seen_px=3.0) for name, size in calibration.checks.items()}
    bad = judge(survey, replace(calibration, checks=off))
    assert bad.grade == "bad"
    assert any(r.grade == "bad" and "check images of navcam_left" in r.sentence for r in bad.reasons)


def test_a_survey_that_leaves_something_open_blames_no_joint(
    fitted: tuple[Survey, Calibration], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    survey, fit = fitted
    chance = replace(fit.wider[0], significant=True, sentence="tilt slipped")
    left_open = Degenerate(("mast.translation_m.z",), "tilt hardly moved")
    opened = replace(fit, degenerate=(left_open,), wider=(chance,))
    monkeypatch.setitem(FITS, "joint", lambda survey, mast_parameters: opened)
    made = calibrate(survey, tmp_path / "mast.yaml")
    assert made.verdict.grade == "bad"
    assert "tilt slipped" not in (tmp_path / "mast.yaml").read_text()


@pytest.mark.parametrize(("count", "first_too"), [(1, False), (2, False), (2, True)])
def test_the_last_images_of_a_camera_left_out_cost_trust(
    fitted: tuple[Survey, Calibration], count: int, first_too: bool
) -> None:
    survey, fit = fitted
    mine = [i.name for i in fit.images if i.camera == "navcam_right" and i.purpose != "check"]
    for names, said in ((mine[-count:], True), (mine[:count], False)):
        lost = {*names, *(mine[:1] if first_too else [])}
        images = [replace(i, used=i.used & (i.name not in lost)) for i in fit.images]
        verdict = judge(survey, replace(fit, images=tuple(images)))
        last = [r for r in verdict.reasons if "of navcam_right w" in r.sentence]
        assert [r.grade for r in last] == ["care"] * said
        assert all(f"changed before {names[0]}, the result is of before" in r.sentence for r in last)


def test_prisms_that_scatter_more_than_their_tapes_cost_trust(
    fitted: tuple[Survey, Calibration],
) -> None:
    survey, fit = fitted
    tapes = Component("tapes", 270, 199.0, 0.24, 0.01, 0.24, 1.0, 1e-80)
    prisms = Component("prisms", 24, 12.0, 1.31, 0.27, 1.0, 0.06, 0.94)
    grades = []
    for factor in (1.31, 0.3):
        components = (tapes, replace(prisms, factor=factor))
        reasons = judge(survey, replace(fit, components=components)).reasons
        grades.append([r.grade for r in reasons if r.sentence.startswith("prisms scatter by")])
    assert grades == [["care"], []]


def test_what_the_papers_method_made_is_judged_by_the_joint_fits_tests(
    fitted: tuple[Survey, Calibration],
) -> None:
    survey = fitted[0]
    stated = replace(survey, sigma=replace(survey.sigma, station_m=survey.sigma.station_m / 4))
    by_paper = fit_paper(stated)
    verdict = judge(stated, by_paper, jointly=fit_joint(stated))
    assert any(
        r.grade == "care" and r.sentence.startswith("fitted jointly, tapes scatter") for r in verdict.reasons
    )
    odd = replace(fitted[1], outliers=(Outlier("image", "image navcam_left-037", 4.7),))
    by_paper = fit_paper(survey)
    found = [r for r in judge(survey, by_paper, jointly=odd).reasons if "image navcam_left-037" in r.sentence]
    assert [r.grade for r in found] == ["care"]
    assert "check tapes, angles and dots" in found[0].sentence
    again = judge(survey, replace(by_paper, outliers=odd.outliers), jointly=odd).reasons
    assert not [r for r in again if "image navcam_left-037" in r.sentence]
    lost = judge(survey, by_paper, jointly=SurveyNotFitted("no start was found"))
    assert lost.grade == "care" and any("was not tested" in r.sentence for r in lost.reasons)
