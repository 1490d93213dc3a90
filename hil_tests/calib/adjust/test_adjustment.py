"""The survey as a least-squares problem: derivatives, and minima of data without noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.adjust.adjustment import Adjustment
from calib.adjust.robust import SurveyNotFitted
from calib.adjust.solver import Normal, minimise
from calib.adjust.terms import lens_knowledge
from calib.adjust.unknowns import MAST
from calib.calibrate.starts.survey import start_values
from calib.calibrate.survey import fit_joint
from calib.geometry.parameters import parameter_names, stepped
from calib.geometry.rig import Rig
from calib.survey.records import Sigma, Survey
from hil_tests.calib.adjust.small_surveys import of_cameras, rings, survey_of
from hil_tests.support.sim_survey.plan import BOARD, SurveyPlan, rover_from_head

RELATIVE = 1e-5
"""Of central differences with steps of a few sigmas' thousandths."""

RECOVERED_M = 1e-9
RECOVERED_PX = 1e-6

EXACT = Sigma(station_m=1e-9, dot_px=1e-7)
"""So small that what lenses are usually like has no weight."""

SMALL = SurveyPlan(rings=rings(3), mast_boards=5, check_boards=1)
ROWS, COLUMNS = np.divmod(np.arange(100), 10)


@pytest.fixture(scope="module")
def survey(true_rig: Rig) -> Survey:
    """Two cameras, skew axes, joints and prisms with sigmas, three set-ups: all that can be unknown."""
    plan = SurveyPlan(rings=rings(2, "navcam", "hazcam"), mast_boards=3, check_boards=0, level_setups=2)
    survey = survey_of(true_rig, 5, plan, sigma=Sigma(0.001, 0.1, 0.0005, 0.002))
    return of_cameras(survey, "navcam_left", "hazcam_left")


@pytest.fixture(scope="module")
def problem(survey: Survey) -> Adjustment:
    return start_values(survey, 8).problem(survey, 8)


def test_every_derivative_is_that_of_differences(problem: Adjustment, survey: Survey) -> None:
    state = start_values(survey, 8).estimate
    normal = problem.normal(state)
    here = [block for _, block in problem.blocks(state)]
    width = 1e-3 / np.sqrt(np.diag(normal.matrix) + problem.weak)
    seen = set()
    for block in here:
        seen.update(block.columns.tolist())
    assert seen == set(range(len(problem.names)))
    for column, name in enumerate(problem.names):
        step = np.zeros(len(problem.names))
        step[column] = width[column]
        ahead = problem.blocks(problem.stepped(state, step))
        behind = problem.blocks(problem.stepped(state, -step))
        for block, (_, more), (_, less) in zip(here, ahead, behind, strict=True):
            difference = (more.residual - less.residual) / (2 * width[column])
            mine = block.jacobian[:, block.columns == column].sum(axis=1)
            scale = np.linalg.norm(block.jacobian, axis=0).max()
            floor = 1e-9 / width[column] + RELATIVE * np.abs(mine).max()
            assert np.abs(mine - difference).max() < max(floor, 1e-12 * scale), name


def test_knowledge_of_lenses_has_the_derivatives_of_differences(true_rig: Rig) -> None:
    for name in ("navcam_left", "hazcam_right"):
        model = true_rig.cameras[name].model
        _, jacobian = lens_knowledge(model)
        for column in range(len(parameter_names(model.kind))):
            step = np.zeros(jacobian.shape[1])
            step[column] = 1e-6
            more, less = (lens_knowledge(stepped(model, sign * step))[0] for sign in (1, -1))
            # The axes across A turn about A as A moves: that changes nothing but second-order terms.
            assert np.abs((more - less) / 2e-6 - jacobian[:, column]).max() < 0.05 / 0.02 * 0.02 + 1e-6, (
                column
            )


def test_noise_free_survey_gives_back_the_rig(true_rig: Rig) -> None:
    fit = fit_joint(survey_of(true_rig, 3, SMALL, sigma=EXACT, noise=0.0))
    assert np.abs(fit.rig.mast.translation_m - true_rig.mast.translation_m).max() < RECOVERED_M
    assert np.abs(fit.rig.mast.rotation_rad - true_rig.mast.rotation_rad).max() < RECOVERED_M
    points = BOARD.dots_in_board_m(ROWS, COLUMNS)[:, [2, 0, 1]] + [4.0, 0.1, -0.5]
    for name, camera in true_rig.cameras.items():
        at = (0.1, -0.2)
        if camera.on == "head":
            head = rover_from_head(true_rig.mast, *at)
            wanted, valid = camera.model.project((points - head.translation_m) @ head.rotation)
        else:
            wanted, valid = camera.model.project(points)
        found, _ = fit.rig.camera_in_rover(name, *at).project(points)
        inside = valid & (wanted > 0).all(axis=1) & (wanted < np.array(camera.model.size_px)).all(axis=1)
        assert inside.any(), name
        assert np.abs(found - wanted)[inside].max() < RECOVERED_PX, name


def test_eight_parameters_find_skew_axes(navcams: Rig) -> None:
    mast = replace(navcams.mast, axis_offset_m=0.021, axis_twist_rad=-0.034)
    fit = fit_joint(survey_of(replace(navcams, mast=mast), 3, SMALL, sigma=EXACT, noise=0.0), 8)
    assert fit.rig.mast.axis_offset_m == pytest.approx(0.021, abs=RECOVERED_M)
    assert fit.rig.mast.axis_twist_rad == pytest.approx(-0.034, abs=RECOVERED_M)


def test_skew_axes_fitted_as_if_they_met_are_refused(navcams: Rig) -> None:
    mast = replace(navcams.mast, axis_offset_m=0.05, axis_twist_rad=0.03)
    with pytest.raises(SurveyNotFitted, match="eight parameters"):
        fit_joint(survey_of(replace(navcams, mast=mast), 3, SMALL), 6)


def test_a_mast_of_four_parameters_stays_upright(navcams: Rig) -> None:
    fit = fit_joint(survey_of(navcams, 1, SMALL), 4)
    assert fit.rig.mast.rotation_rad[:2].tolist() == [0.0, 0.0]
    assert [n for n in fit.parameter_names if "rotation" in n] == ["mast.rotation_rad.z"]


def test_unknowns_have_names_and_places(problem: Adjustment) -> None:
    assert [problem.names[i] for i in problem.at(MAST)][-2:] == ["mast.axis_offset_m", "mast.axis_twist_rad"]
    assert len(set(problem.names)) == len(problem.names)


class Valley:
    """Rosenbrock's valley as residuals, and a third unknown that nothing depends on."""

    def normal(self, state: np.ndarray) -> Normal:
        x, y, _ = state
        residual = np.array([10 * (y - x * x), 1 - x])
        jacobian = np.array([[-20 * x, 10.0, 0.0], [-1.0, 0.0, 0.0]])
        return Normal(float(residual @ residual), jacobian.T @ jacobian, jacobian.T @ residual)

    def cost(self, state: np.ndarray) -> float:
        return self.normal(state).cost

    def stepped(self, state: np.ndarray, step: np.ndarray) -> np.ndarray:
        return np.asarray(state + step)


def test_minimum_is_found_and_what_nothing_depends_on_stays() -> None:
    found = minimise(Valley(), np.array([-1.2, 1.0, 7.0]), weak=np.full(3, 1e-6))
    assert found.settled
    assert np.abs(found.state - [1.0, 1.0, 7.0]).max() < 1e-8


class Rounded(Valley):
    """The lowest place of a cost of 1, but for rounding: a gradient is left, and each trial looks lower."""

    def normal(self, state: np.ndarray) -> Normal:
        return Normal(1.0, np.eye(3), np.full(3, 3e-5))

    def cost(self, state: np.ndarray) -> float:
        return 1.0 - 1e-12


def test_a_fit_that_gains_by_rounding_alone_has_settled() -> None:
    found = minimise(Rounded(), np.zeros(3))
    assert found.settled and found.steps < 5


@pytest.mark.parametrize("gain", [1e-1, 1e-4, 1e-10])
def test_normal_equations_are_those_of_the_state_where_a_fit_ended(gain: float) -> None:
    valley = Valley()
    found = minimise(valley, np.array([-1.2, 1.0, 7.0]), weak=np.full(3, 1e-6), gain=gain)
    there = valley.normal(found.state)
    assert found.settled
    assert found.normal.cost == there.cost
    assert np.array_equal(found.normal.matrix, there.matrix)
    assert np.array_equal(found.normal.gradient, there.gradient)


def test_no_meaning_hangs_on_the_order_in_which_unknowns_are_declared(
    survey: Survey, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = fit_joint(survey)
    declared = Adjustment._declared
    monkeypatch.setattr(Adjustment, "_declared", lambda self, start: reversed(list(declared(self, start))))
    other = fit_joint(survey)
    assert other.parameter_names[:6] == one.parameter_names[:6]  # the mast's come first whatever is declared
    at = [other.parameter_names.index(name) for name in one.parameter_names]
    np.testing.assert_allclose(other.estimate[at], one.estimate, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(np.diag(other.covariance)[at], np.diag(one.covariance), rtol=1e-4)
    gains = {found.name: found.gain for found in (*one.wider, *one.contradictions)}
    assert {found.name: found.gain for found in (*other.wider, *other.contradictions)} == pytest.approx(
        gains, rel=1e-3, abs=1e-3
    )
