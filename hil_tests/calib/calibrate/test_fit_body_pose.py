"""A body pair's correction: motions made with SciPy, projected by a plain formula, found again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.calibrate.body import (
    PRIOR_SHIFT_M,
    PRIOR_TURN_RAD,
    BodyPose,
    body_groups,
    body_sights,
    corrected_covariance,
    corrected_rig,
    fit_body_pose,
)
from calib.errors import NoCorrection
from calib.files.mast_file import load_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import RigCovariance, moved_rig
from calib.geometry.parameters import parameter_names, parameter_part
from calib.geometry.rig import Rig
from calib.geometry.rigid import tangents
from hil_tests.calib.matching.handed_over import (
    HAZCAMS,
    NAVCAMS,
    hand_offs,
    moved_hazcams,
    pixel,
    plain_rig,
    targets,
    vectors,
    with_found,
)

TURN_RAD = np.array([0.001, 0.005, -0.002])
SHIFT_M = np.array([0.003, -0.002, 0.001])
DRAWS = 40


@pytest.fixture(scope="module")
def rig(repository: Path) -> Rig:
    """The simulated rover's rig with Hazcams that a plain formula projects."""
    return plain_rig(load_rig(repository / "configs/sim/rocky8.yaml").rig)


def fitted(rig: Rig, step: np.ndarray, seed: int, count: int = 24, **noise: float) -> BodyPose:
    """The correction of a rig whose Hazcams truly stand elsewhere by a step."""
    rng = np.random.default_rng(seed)
    true = moved_hazcams(rig, Rotation.from_rotvec(step[:3]), step[3:])
    made = hand_offs(true, rig, targets(rng, count), rng, **noise)  # type: ignore[arg-type]
    return fit_body_pose(rig, HAZCAMS, made)


def chi2_of(fit: BodyPose, step: np.ndarray) -> float:
    off = fit.step - step
    return float(off @ np.linalg.solve(fit.covariance, off))


def test_exact_hand_offs_give_the_motion_exactly_and_no_residual(rig: Rig) -> None:
    step = np.concatenate([TURN_RAD, SHIFT_M])
    rng = np.random.default_rng(1)
    true = moved_hazcams(rig, Rotation.from_rotvec(TURN_RAD), SHIFT_M)
    made = hand_offs(true, rig, targets(rng, 400), rng, click_px=1e-3, match_px=0.0)
    exact = [
        replace(one, landed={n: replace(one.landed[n], found_px=pixel(true[n], p)) for n in HAZCAMS})
        for one, p in zip(made, targets(np.random.default_rng(1), 400), strict=True)
    ]
    fit = fit_body_pose(rig, HAZCAMS, exact)
    # The prior still pulls a little: 1 part in some hundred of what 400 hand-offs say.
    assert np.abs(fit.step - step).max() < 0.2e-3
    assert max(max(after) for _, after in fit.rms_px.values()) < 0.02
    corrected = corrected_rig(rig, fit)
    for name in HAZCAMS:
        for letter in "CAHVO":
            bound = 0.4 if letter in "HV" else 4e-4
            off = getattr(corrected.cameras[name].model, letter) - true[name][letter]
            assert np.abs(off).max() < bound, (name, letter)
    for name in rig.cameras:
        if name not in HAZCAMS:
            assert corrected.cameras[name] is rig.cameras[name]
    assert corrected.mast is rig.mast


def test_drawn_motions_come_back_within_the_stated_covariance(rig: Rig) -> None:
    rng = np.random.default_rng(21)
    prior = np.array([PRIOR_TURN_RAD] * 3 + [PRIOR_SHIFT_M] * 3)
    found = []
    for seed in range(DRAWS):
        step = rng.normal(0.0, prior)
        found.append(chi2_of(fitted(rig, step, seed), step))
    # Six numbers: mean 6, sigma of the mean of 40 draws 0.55.
    assert abs(np.mean(found) - 6.0) < 1.8
    assert np.mean(np.array(found) < 12.59) > 0.85  # the 95 % point


def test_where_the_scatter_is_three_times_what_is_stated_the_covariance_grows_with_it(rig: Rig) -> None:
    found = []
    for seed in range(20):
        step = np.random.default_rng(seed).normal(0.0, [0.002] * 3 + [0.002] * 3)
        fit = fitted(rig, step, 900 + seed, match_px=1.2)
        assert fit.scale > 2.0
        found.append(chi2_of(fit, step))
    assert 3.0 < np.mean(found) < 9.0  # 6 expected; sigma of the mean of 20 draws is 0.8


def test_the_papers_bias_is_found_and_the_residuals_go(rig: Rig) -> None:
    step = np.concatenate([TURN_RAD, SHIFT_M])
    fit = fitted(rig, step, 5)
    assert fit.significant and fit.sigmas > 10
    assert chi2_of(fit, step) < 22.5  # one in a thousand
    for before, after in fit.rms_px.values():
        assert np.hypot(*before) > 2.0 > 1.0 > np.hypot(*after)
    assert fit.chi2_after < 1.6 * fit.degrees_of_freedom < fit.chi2_before
    assert not fit.outliers


@pytest.mark.parametrize("match_px", [0.4, 1.2])
def test_without_a_motion_it_is_significant_as_rarely_as_stated(rig: Rig, match_px: float) -> None:
    """1.2 px where 0.4 are stated: the residuals' own scatter is then what counts."""
    chances = np.array(
        [fitted(rig, np.zeros(6), 500 + seed, 12, match_px=match_px).chance for seed in range(DRAWS)]
    )
    assert np.sum(chances < 0.05) <= 7  # 2 expected of 40; 8 and more come once in 1000 times
    assert np.sum(chances < 0.5) >= 10
    assert (chances >= 0.0027).all() or np.sum(chances < 0.0027) == 1


def test_every_hand_off_that_is_used_counts_in_full_against_the_prior(rig: Rig) -> None:
    """At the least squares' minimum what the hand-offs pull and what the prior pulls are the same."""
    fit = fitted(rig, np.concatenate([TURN_RAD, SHIFT_M]), 5)
    at = fit.used.equations(fit.step)
    pulls = [
        r.T @ np.linalg.solve(c, e)
        for r, c, e in zip(at.rates, at.covariance_px2, at.residual_px, strict=True)
    ]
    prior = np.array([PRIOR_TURN_RAD] * 3 + [PRIOR_SHIFT_M] * 3)
    sigma = np.sqrt(np.diag(fit.covariance))
    assert (sigma * np.abs(np.sum(pulls, axis=0) / fit.scale - fit.step / prior**2)).max() < 0.01


def test_blunders_are_named_and_do_not_move_the_result(rig: Rig) -> None:
    rng = np.random.default_rng(9)
    step = np.concatenate([TURN_RAD, SHIFT_M])
    made = hand_offs(moved_hazcams(rig, Rotation.from_rotvec(TURN_RAD), SHIFT_M), rig, targets(rng, 30), rng)
    for index, camera, off in (
        (3, 0, (8.0, 0.0)),
        (11, 1, (-3.0, 5.0)),
        (20, 0, (0.0, -6.0)),
        (21, 0, (30.0, 9)),
    ):
        made[index] = with_found(made[index], HAZCAMS[camera], off)
    fit = fit_body_pose(rig, HAZCAMS, made)
    assert {one.name for one in fit.outliers} == {f"hand-off {i}" for i in (3, 11, 20, 21)}
    assert all("off by" in one.sentence for one in fit.outliers)
    assert chi2_of(fit, step) < 22.5
    worst = max(fit.outliers, key=lambda one: one.size)
    assert worst.name == "hand-off 21" and abs(worst.size - np.hypot(30, 9)) < 2.0


def test_a_quarter_that_err_alike_do_not_pull_the_rest_along(rig: Rig) -> None:
    """As when the picture shows the next stone: as many as that shift a plain mean by 3 px."""
    rng = np.random.default_rng(10)
    step = np.concatenate([TURN_RAD, SHIFT_M])
    made = hand_offs(moved_hazcams(rig, Rotation.from_rotvec(TURN_RAD), SHIFT_M), rig, targets(rng, 28), rng)
    wrong = (1, 4, 9, 13, 16, 22, 27)
    for index in wrong:
        made[index] = with_found(with_found(made[index], HAZCAMS[0], (9.0, 7.0)), HAZCAMS[1], (9.0, 7.0))
    fit = fit_body_pose(rig, HAZCAMS, made)
    assert {one.name for one in fit.outliers} == {f"hand-off {i}" for i in wrong}
    assert chi2_of(fit, step) < 22.5


def test_clicks_of_two_things_are_named_and_not_used(rig: Rig) -> None:
    """8 px off across the lines in one hand-off: its point is off by as much in both Hazcams alike."""
    rng = np.random.default_rng(12)
    true = {name: vectors(rig, name) for name in HAZCAMS}
    made = hand_offs(true, rig, targets(rng, 24), rng)
    spoiled = made[7].clicks_px + np.array([[0.0, 0.0], [0.0, 8.0]])
    made[7] = replace(made[7], clicks_px=spoiled, name="line 8")
    fit = fit_body_pose(rig, HAZCAMS, made)
    assert [one.name for one in fit.outliers] == ["line 8"]
    assert "its two clicks do not mean one point, they are " in fit.outliers[0].sentence
    assert len(fit.used.handoffs) == 23


def test_clicks_of_cameras_that_the_covariance_leaves_out_may_be_off_as_without_one(rig: Rig) -> None:
    rng = np.random.default_rng(12)
    made = hand_offs({name: vectors(rig, name) for name in HAZCAMS}, rig, targets(rng, 24), rng)
    made[7] = replace(made[7], clicks_px=made[7].clicks_px + np.array([[0.0, 0.0], [0.0, 3.0]]))
    fit = {"parameters": ["mast.translation_m.z"], "covariance": [[1e-12]]}
    for one in (rig, replace(rig, fit=fit)):
        assert body_sights(one, HAZCAMS, made).apart == ()


def test_what_turns_mast_and_body_alike_is_no_correction(rig: Rig) -> None:
    """The rover frame is the mast's: another frame for the whole rig changes no pixel."""
    turn, shift = Rotation.from_rotvec([0.01, -0.02, 0.03]), np.array([0.02, 0.01, -0.03])
    fixed = turn * Rotation.from_euler("XYZ", rig.mast.rotation_rad)
    mast = replace(
        rig.mast,
        rotation_rad=fixed.as_euler("XYZ"),
        translation_m=turn.apply(np.array(rig.mast.translation_m)) + shift,
    )
    cameras = dict(rig.cameras)
    for name in HAZCAMS:
        own = vectors(rig, name)
        carried = {letter: turn.apply(own[letter]) for letter in "AHVO"} | {"C": turn.apply(own["C"]) + shift}
        size = cameras[name].model.size_px
        cameras[name] = replace(cameras[name], model=CameraModel("CAHVOR", size, **carried, R=own["R"]))
    elsewhere = replace(rig, mast=mast, cameras=cameras)
    rng = np.random.default_rng(4)
    step = np.concatenate([TURN_RAD, SHIFT_M])
    made = hand_offs(moved_hazcams(rig, Rotation.from_rotvec(TURN_RAD), SHIFT_M), rig, targets(rng, 24), rng)
    here, there = (fit_body_pose(which, HAZCAMS, made) for which in (rig, elsewhere))
    np.testing.assert_allclose(there.step[:3], turn.apply(here.step[:3]), atol=2e-7)
    np.testing.assert_allclose(there.step[3:], turn.apply(here.step[3:]), atol=2e-7)
    assert there.chance == pytest.approx(here.chance, rel=1e-3, abs=1e-300)
    unmoved = hand_offs({n: vectors(rig, n) for n in HAZCAMS}, rig, targets(rng, 24), rng)
    assert not fit_body_pose(elsewhere, HAZCAMS, unmoved).significant
    assert step.any()


def test_targets_at_one_range_leave_directions_to_the_prior_by_name(rig: Rig) -> None:
    rng = np.random.default_rng(2)
    along = np.linspace(-0.3, 0.3, 10)
    points = np.column_stack([2.0 * np.cos(along), 2.0 * np.sin(along), np.full(10, -0.1)])
    fit = fit_body_pose(
        rig, HAZCAMS, hand_offs(moved_hazcams(rig, Rotation.identity(), SHIFT_M), rig, points, rng)
    )
    assert fit.seen < 6 and len(fit.unseen) == 6 - fit.seen
    assert all("not determined" in sentence and "prior" in sentence for sentence in fit.unseen)
    sigma = np.sqrt(np.diag(fit.covariance))
    assert (sigma <= np.array([PRIOR_TURN_RAD] * 3 + [PRIOR_SHIFT_M] * 3)).all()


def test_too_few_one_sided_and_contradicting_hand_offs_are_refused_by_name(rig: Rig) -> None:
    rng = np.random.default_rng(7)
    true = {n: vectors(rig, n) for n in HAZCAMS}

    def refused(points: np.ndarray, spoil: int = 0) -> str:
        made = hand_offs(true, rig, points, rng)
        for index in range(spoil):
            made[index] = with_found(made[index], HAZCAMS[0], tuple(rng.uniform(-40, 40, 2)))
        with pytest.raises(NoCorrection) as caught:
            fit_body_pose(rig, HAZCAMS, made)
        return caught.value.code

    assert refused(targets(rng, 7)) == "too_few"
    assert refused(np.array([2.0, 0.1, -0.1]) + rng.normal(0, 0.02, (30, 3))) == "one_sided"
    assert refused(targets(rng, 24), spoil=12) == "inconsistent"
    elsewhere = [
        replace(one, pair=HAZCAMS) for one in hand_offs(true, rig, targets(rng, 24), rng)
    ]  # from the body: says nothing of the body against the mast
    with pytest.raises(NoCorrection) as caught:
        fit_body_pose(rig, HAZCAMS, elsewhere)
    assert caught.value.code == "too_few"
    least = hand_offs(true, rig, targets(rng, 8), rng)
    assert len(fit_body_pose(rig, HAZCAMS, least).used.handoffs) == 8


def test_groups_are_the_pairs_and_lone_cameras_of_the_body(rig: Rig) -> None:
    assert body_groups(rig) == {"hazcam": HAZCAMS}
    alone = replace(rig, stereo={"navcam": NAVCAMS})
    assert body_groups(alone) == {name: (name,) for name in HAZCAMS}


def parameters(rig: Rig, names: tuple[str, ...], against: Rig) -> np.ndarray:
    """A rig's parameters less another's, which is near it, in the names' units."""
    out = np.zeros(len(names))
    for camera in HAZCAMS + NAVCAMS:
        one, other = rig.cameras[camera].model, against.cameras[camera].model
        parts = np.zeros(len(parameter_names(one.kind)))
        for letter in one.kind:
            off = getattr(one, letter) - getattr(other, letter)
            off = (
                tangents(getattr(other, letter)) @ off
                if letter in "AO"
                else off[1:]
                if letter == "R"
                else off
            )
            parts[parameter_part(one.kind, letter)] = off
        for name, value in zip(parameter_names(one.kind), parts, strict=True):
            out[names.index(f"cameras.{camera}.{name}")] = value
    mast = np.concatenate([rig.mast.translation_m, rig.mast.rotation_rad])
    out[:6] = mast - np.concatenate([against.mast.translation_m, against.mast.rotation_rad])
    return out


def test_the_covariance_after_is_what_differences_of_the_whole_fit_give(rig: Rig) -> None:
    """Each direction u of the believed parameters, taken as their only uncertainty."""
    rng = np.random.default_rng(3)
    step = np.concatenate([TURN_RAD, SHIFT_M])
    made = hand_offs(moved_hazcams(rig, Rotation.from_rotvec(TURN_RAD), SHIFT_M), rig, targets(rng, 24), rng)
    fit = fit_body_pose(rig, HAZCAMS, made)
    assert chi2_of(fit, step) < 22.5
    names = tuple(f"mast.{key}.{axis}" for key in ("translation_m", "rotation_rad") for axis in "xyz")
    for camera in HAZCAMS + NAVCAMS:
        names += tuple(f"cameras.{camera}.{part}" for part in parameter_names(rig.cameras[camera].model.kind))
    nothing = corrected_covariance(rig, RigCovariance(names, np.zeros((len(names),) * 2)), fit).covariance
    assert np.linalg.eigvalsh(nothing)[0] > -1e-9 * np.linalg.eigvalsh(nothing)[-1]
    before = corrected_rig(rig, fit)
    scale = np.array([300.0 if n.split(".")[-2] in "HV" else 1.0 for n in names])
    for index in range(6):
        u = rng.normal(0.0, 1e-4, len(names)) * scale if index < 5 else np.zeros(len(names))
        if index == 5:
            u[4] = 1e-3  # the mast pitches: the body has to follow
        known = RigCovariance(names, np.outer(u, u))
        told = corrected_covariance(rig, known, fit).covariance - nothing
        ends = []
        for sign in (0.5, -0.5):
            believed = moved_rig(rig, names, sign * u)
            after = corrected_rig(believed, fit_body_pose(believed, HAZCAMS, made))
            ends.append(parameters(after, names, before))
        v = ends[0] - ends[1]
        difference = np.abs(told - np.outer(v, v)) / np.outer(scale, scale)
        assert difference.max() < 0.03 * np.max(np.abs(told) / np.outer(scale, scale)), index
