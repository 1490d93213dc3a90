"""Blunders of every kind are named, left out, and leave the rest as it was."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calib.adjust.outliers import LeftOut, judge
from calib.adjust.result import Calibration
from calib.adjust.robust import SurveyNotFitted
from calib.adjust.terms import ImageTerm
from calib.adjust.unknowns import ResidualBlock
from calib.calibrate.paper import fit_paper
from calib.calibrate.survey import fit_joint
from calib.geometry.rig import Rig
from calib.survey.records import Survey
from hil_tests.calib.adjust.small_surveys import survey_of, with_shifted_dots, with_swapped_dots
from hil_tests.support.sim_survey.blunders import (
    with_fewer_dots,
    with_moved_tape,
    with_scattered_dots,
    with_wrong_prism,
)

SEED = 6
MORE_DOTS = pytest.mark.long(
    2, "a denser board; a survey of fewer dots, which is harder, is in the quick run"
)
SIGMAS_OFF = 3.0
"""How far a fit without the bad measurement may be from the fit of the good survey, in its sigmas."""


@pytest.fixture(scope="module")
def survey(navcams: Rig) -> Survey:
    return survey_of(navcams, SEED)


@pytest.fixture(scope="module")
def good(survey: Survey) -> Calibration:
    return fit_joint(survey)


def images(survey: Survey, camera: str, purpose: str) -> list[str]:
    return [i.name for i in survey.images if i.camera == camera and i.purpose == purpose]


def names(fit: Calibration) -> set[str]:
    return {o.name for o in fit.outliers}


def assert_unharmed(fit: Calibration, good: Calibration) -> None:
    n = len(good.part("mast."))
    off = np.abs(fit.estimate[:n] - good.estimate[:n]) / np.sqrt(np.diag(good.covariance)[:n])
    assert off.max() < SIGMAS_OFF
    assert fit.chi2_probability > 0.001


def test_a_good_survey_loses_nothing(good: Calibration) -> None:
    assert good.outliers == ()


@pytest.mark.parametrize("shift_m", [(0.01, 0.0, 0.008), (0.3, 0.0, 0.0)])
def test_a_wrong_tape_is_named_in_a_sentence(
    survey: Survey, good: Calibration, shift_m: tuple[float, float, float]
) -> None:
    fit = fit_joint(with_moved_tape(survey, "level", "mast-3", "b", shift_m))
    assert names(fit) == {"tape b of placement mast-3 (set-up level)"}
    assert fit.outliers[0].size == pytest.approx(np.linalg.norm(shift_m), abs=0.005)
    assert fit.outliers[0].sentence == (
        "tape b of placement mast-3 (set-up level) is off by "
        f"{1000 * fit.outliers[0].size:.1f} mm and was not used"
    )
    assert_unharmed(fit, good)


@pytest.mark.parametrize("shift_m", [0.015])
def test_a_wrong_prism_is_named(survey: Survey, shift_m: float) -> None:
    wrong = with_wrong_prism(survey, "level", "p2", (shift_m, 0.0, 0.0))
    for fit in (fit_joint, fit_paper):
        assert names(fit(wrong)) == {"prism p2 of set-up level"}


def test_wrong_dots_are_named(survey: Survey, good: Calibration) -> None:
    one, other = images(survey, "navcam_left", "camera")[1:3]
    wrong = with_shifted_dots(survey, one, (1.0, 0.0), 17)
    fit = fit_joint(with_shifted_dots(wrong, other, (0.0, 300.0), 50))
    assert names(fit) == {f"image {one} dot (row 1, column 7)", f"image {other} dot (row 5, column 0)"}
    assert_unharmed(fit, good)


@pytest.mark.parametrize(
    ("seed", "every", "tape"),
    [
        pytest.param(1, 1, ("tilted-back", "hazcam-3m-2", "b"), marks=MORE_DOTS),
        (4, 2, ("level", "navcam-6m-3", "a")),
    ],
)
def test_a_start_lives_through_dots_found_anywhere_and_a_tape_5_cm_aside(
    true_rig: Rig, seed: int, every: int, tape: tuple[str, str, str]
) -> None:
    """Five dots in a hundred of every image, or one in 25, those of check images too, and a tape."""
    rng = np.random.default_rng([seed, 5])
    survey, wrong = with_fewer_dots(survey_of(true_rig, seed), every), set[str]()
    for image in survey.images:
        count = round(0.05 * len(survey.dots[image.name].rows))
        survey, places = with_scattered_dots(survey, image.name, count, rng)
        wrong |= {f"image {image.name} dot (row {r}, column {c})" for r, c in places}
    setup, placement, point = tape
    survey = with_moved_tape(survey, *tape, (-0.03, 0.04, 0.01))
    fit = fit_joint(survey)
    assert names(fit) >= wrong | {f"tape {point} of placement {placement} (set-up {setup})"}
    assert len(fit.outliers) <= len(wrong) + 2
    truth = np.array([*true_rig.mast.translation_m, *true_rig.mast.rotation_rad])
    off = np.abs(fit.estimate[:6] - truth) / np.sqrt(np.diag(fit.covariance)[:6])
    assert off.max() < SIGMAS_OFF


@pytest.mark.parametrize("shift_px", [3.0, 150.0])
def test_a_shifted_image_is_named(survey: Survey, good: Calibration, shift_px: float) -> None:
    image = images(survey, "navcam_left", "mast")[2]
    fit = fit_joint(with_shifted_dots(survey, image, (shift_px, 0.0)))
    assert names(fit) == {f"image {image}"}
    assert fit.outliers[0].size == pytest.approx(shift_px, abs=0.15)
    assert_unharmed(fit, good)


@pytest.mark.parametrize("purpose", ["camera", "mast"])
@pytest.mark.parametrize("method", [fit_joint, fit_paper])
def test_two_boards_mixed_up_are_named(survey: Survey, purpose: str, method) -> None:  # type: ignore[no-untyped-def]
    one, other = images(survey, "navcam_left", purpose)[:2]
    fit = method(with_swapped_dots(survey, one, other))
    assert names(fit) == {f"image {one}", f"image {other}"}


def test_nonsense_is_refused_and_never_reported_as_done(survey: Survey) -> None:
    bad = images(survey, "navcam_left", "camera")
    for one, other in zip(bad[::2], bad[1::2], strict=True):
        survey = with_swapped_dots(survey, one, other)
    with pytest.raises(SurveyNotFitted, match="navcam_left"):
        fit_joint(survey)


def test_the_upright_mast_of_the_paper_leaves_nothing_out(navcams: Rig) -> None:
    six = fit_paper(survey_of(navcams, 1))
    four = fit_paper(survey_of(navcams, 1), 4)
    assert not four.outliers and not six.outliers
    assert max(four.rms_px["navcam_left"]) > 5 * max(six.rms_px["navcam_left"])


@pytest.mark.parametrize("fitted", [True, False])
@pytest.mark.parametrize(("off_sigmas", "good"), [(4.6, True), (5.2, False)])
def test_a_dot_that_few_others_check_is_judged_by_what_the_fit_leaves_of_it(
    fitted: bool, off_sigmas: float, good: bool
) -> None:
    """One unknown place under three dots, and twenty dots elsewhere that say nothing about it.

    The third dot is off by b sigmas. Worked by hand, b² 2/3 is chi-square of two whether the place is the
    mean of all three (residual 2/3 b, variance 1 - 1/3) or of the other two (b, variance 1 + 1/2). One dot
    of 23 in a hundred surveys is beyond 2 ln 2300 = 15.5: 4.6² 2/3 = 14.1 is not, 5.2² 2/3 = 18.0 is.
    """
    jacobian = np.zeros((23, 2, 2))
    jacobian[20:] = np.eye(2)
    keep = np.ones(23, dtype=bool)
    keep[22] = fitted
    residual = np.zeros((23, 2))
    residual[20:, 0] = (
        [-off_sigmas / 3, -off_sigmas / 3, 2 * off_sigmas / 3] if fitted else [0, 0, off_sigmas]
    )
    block = ResidualBlock(residual.ravel(), jacobian.reshape(46, 2), np.arange(2))
    places, counts = np.zeros((23, 3)), np.arange(23)
    term = ImageTerm(
        "one", "left", ("s", "p"), None, 0, 0, counts, counts, places, residual, np.ones(23), keep
    )
    left, _ = judge(problem_of([term], [block]), None, np.eye(2) / keep[20:].sum(), [term])  # type: ignore[arg-type]
    assert left[0].keep.tolist() == [True] * 22 + [good]


@pytest.mark.parametrize(
    ("common_sigmas", "own_sigmas", "tilted_sigmas", "comes_back"),
    [(12.0, 0.5, 0.0, True), (30.0, 0.5, 0.0, False), (0.0, 0.5, 5.0, False), (0.0, 3.0, 0.0, True)],
)
def test_an_image_left_out_is_judged_by_what_its_dots_share_beyond_noise(
    common_sigmas: float, own_sigmas: float, tilted_sigmas: float, comes_back: bool
) -> None:
    """Twenty dots in a line under one place, which is known to five sigma of a dot (covariance 25).

    Off together by 12 they are off by 2.4 sigma of the prediction: 12² 20 / (1 + 25 · 20) = 5.7 and no
    reason, though each by itself is at 12² / 26 and their sum at 111, where 82 is the limit of forty numbers.
    Off together by 30, each is beyond 2 ln 2000 = 15.2. Off by -5 to 5 from end to end they are no one
    place: 5² 20 / 3 = 184, though each by itself is at 25 / 26. Off by 3 to either side in turn they are
    noisier than stated.
    """
    jacobian = np.tile(np.eye(2), (20, 1, 1))
    residual, places = np.zeros((20, 2)), np.zeros((20, 3))
    places[:, 0] = np.linspace(-1.0, 1.0, 20)
    residual[:, 0] = common_sigmas + own_sigmas * np.resize([1.0, -1.0], 20) + tilted_sigmas * places[:, 0]
    block = ResidualBlock(residual.ravel(), jacobian.reshape(40, 2), np.arange(2))
    counts = np.arange(20)
    none = np.zeros(20, dtype=bool)
    term = ImageTerm(
        "one", "left", ("s", "p"), None, 0, 0, counts, counts, places, residual, np.ones(20), none
    )
    left, _ = judge(problem_of([term], [block]), None, 25.0 * np.eye(2), [term])  # type: ignore[arg-type]
    assert left[0].keep.tolist() == [comes_back] * 20


def test_dots_of_a_board_that_stands_anywhere_are_judged_by_one_another() -> None:
    """Two unknowns that move all dots alike, and that no other measurement limits."""
    residual = np.tile([5.0, 5.0], 20)
    residual[6] += 40.0
    image = LeftOut(residual, np.full((40, 2), 1e9))
    assert image.agreeing(np.ones(20, dtype=bool), 15.5).tolist() == [True] * 3 + [False] + [True] * 16


@pytest.mark.parametrize(("shift_sigmas", "stays"), [(0.0, True), (1.5, False)])
def test_an_image_with_two_noisy_rows_fails_by_a_common_shift_alone(shift_sigmas: float, stays: bool) -> None:
    """Two rows of eight have three times the noise, as edges along rows of pixels; four images have not."""
    rows, columns = np.divmod(np.arange(88), 11)
    residual = np.random.default_rng(2).standard_normal((5, 88, 2))
    residual[0, np.isin(rows, (3, 4))] *= 3.0
    residual[0, :, 0] += shift_sigmas
    places = np.stack([columns, rows, 0 * rows], axis=1) * 0.045
    once = np.ones(88)
    terms = [
        ImageTerm(str(i), "left", ("s", str(i)), None, 0, 0, rows, columns, places, off, once, once > 0)
        for i, off in enumerate(residual)
    ]
    rates = np.tile(np.eye(2), (88, 1))
    blocks = [ResidualBlock(off.ravel(), rates, np.arange(2)) for off in residual]
    left, _ = judge(problem_of(terms, blocks), None, 1e-6 * np.eye(2), terms)  # type: ignore[arg-type]
    assert [bool(image.keep.any()) for image in left] == [stays, True, True, True, True]


def problem_of(terms: list[ImageTerm], blocks: list[ResidualBlock]) -> Any:
    return SimpleNamespace(
        images=terms,
        station=[],
        huber=None,
        blocks_of=lambda state, terms: blocks if terms else [],
    )
