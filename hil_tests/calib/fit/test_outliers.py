"""Blunders of every kind are named, left out, and leave the rest as it was."""

from __future__ import annotations

import numpy as np
import pytest

from calib.fit.calibration import Calibration
from calib.fit.joint import fit_joint
from calib.fit.paper import fit_paper
from calib.fit.start_values import SurveyNotFitted
from calib.mast.rig import Rig
from calib.survey import SurveyImage
from hil_tests.calib.fit.made_survey import Blunders, make_survey

SEED = 6
SIGMAS_OFF = 3.0
"""How far a fit without the bad measurement may be from the fit of the good survey, in its sigmas."""


def images(rig: Rig, camera: str, purpose: str) -> list[SurveyImage]:
    made = make_survey(rig, SEED)
    return [i for i in made.images if i.camera == camera and i.purpose == purpose]


@pytest.fixture(scope="module")
def good(navcams: Rig) -> Calibration:
    return fit_joint(make_survey(navcams, SEED))


def names(fit: Calibration) -> set[str]:
    return {o.name for o in fit.outliers}


def assert_unharmed(fit: Calibration, good: Calibration) -> None:
    n = len(good.part("mast."))
    off = np.abs(fit.estimate[:n] - good.estimate[:n]) / np.sqrt(np.diag(good.covariance)[:n])
    assert off.max() < SIGMAS_OFF
    assert fit.chi2_probability > 0.001


def test_a_good_survey_loses_nothing(good: Calibration) -> None:
    assert good.outliers == ()


@pytest.mark.parametrize("shift_m", [(0.01, 0.0, 0.008), (0.05, 0.0, 0.04), (0.3, 0.0, 0.0)])
def test_a_wrong_tape_is_named(navcams: Rig, good: Calibration, shift_m: tuple[float, float, float]) -> None:
    fit = fit_joint(make_survey(navcams, SEED, blunders=Blunders(tapes=(("mast-3", "b", shift_m),))))
    assert names(fit) == {"tape b of placement mast-3 (set-up level0)"}
    assert fit.outliers[0].size == pytest.approx(np.linalg.norm(shift_m), abs=0.005)
    assert_unharmed(fit, good)


@pytest.mark.parametrize("shift_m", [0.015, 0.3])
def test_a_wrong_prism_is_named(navcams: Rig, shift_m: float) -> None:
    blunders = Blunders(prisms=(("level0", "p2", (shift_m, 0.0, 0.0)),))
    for fit in (fit_joint, fit_paper):
        assert names(fit(make_survey(navcams, SEED, blunders=blunders))) == {"prism p2 of set-up level0"}


def test_wrong_dots_are_named(navcams: Rig, good: Calibration) -> None:
    one, other = images(navcams, "navcam_left", "camera")[1:3]
    blunders = Blunders(dots=((one.name, 17, (1.0, 0.0)), (other.name, 50, (0.0, 300.0))))
    fit = fit_joint(make_survey(navcams, SEED, blunders=blunders))
    assert names(fit) == {
        f"image {one.name} dot (row 1, column 7)",
        f"image {other.name} dot (row 5, column 0)",
    }
    assert_unharmed(fit, good)


@pytest.mark.parametrize("shift_px", [3.0, 8.0, 150.0])
def test_a_shifted_image_is_named(navcams: Rig, good: Calibration, shift_px: float) -> None:
    image = images(navcams, "navcam_left", "mast")[2].name
    fit = fit_joint(make_survey(navcams, SEED, blunders=Blunders(dots=((image, -1, (shift_px, 0.0)),))))
    assert names(fit) == {f"image {image}"}
    assert fit.outliers[0].size == pytest.approx(shift_px, abs=0.15)
    assert_unharmed(fit, good)


@pytest.mark.parametrize("purpose", ["camera", "mast"])
@pytest.mark.parametrize("method", [fit_joint, fit_paper])
def test_two_boards_mixed_up_are_named(navcams: Rig, purpose: str, method) -> None:  # type: ignore[no-untyped-def]
    one, other = (i.name for i in images(navcams, "navcam_left", purpose)[:2])
    fit = method(make_survey(navcams, SEED, blunders=Blunders(swapped=((one, other),))))
    assert names(fit) == {f"image {one}", f"image {other}"}


def test_nonsense_is_refused_and_never_reported_as_done(navcams: Rig) -> None:
    bad = images(navcams, "navcam_left", "camera")
    pairs = tuple((a.name, b.name) for a, b in zip(bad[::2], bad[1::2], strict=True))
    with pytest.raises(SurveyNotFitted, match="navcam_left"):
        fit_joint(make_survey(navcams, SEED, blunders=Blunders(swapped=pairs)))


def test_every_outlier_has_a_sentence(navcams: Rig) -> None:
    blunders = Blunders(tapes=(("mast-3", "b", (0.05, 0.0, 0.0)),))
    fit = fit_joint(make_survey(navcams, SEED, blunders=blunders))
    assert fit.outliers[0].sentence == (
        "tape b of placement mast-3 (set-up level0) is off by "
        f"{1000 * fit.outliers[0].size:.1f} mm and was not used"
    )
    assert fit.outliers[0].statistic > fit.outliers[0].limit


def test_the_upright_mast_of_the_paper_leaves_nothing_out(navcams: Rig) -> None:
    six = fit_paper(make_survey(navcams, 1))
    four = fit_paper(make_survey(navcams, 1), 4)
    assert not four.outliers and not six.outliers
    assert max(four.rms_px["navcam_left"]) > 5 * max(six.rms_px["navcam_left"])
