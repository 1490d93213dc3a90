"""A bench fitted from pictures alone: pixels by OpenCV, poses by SciPy, joints by the simulator's gears."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from calib.adjust import hypotheses
from calib.adjust.adjustment import PAN_TILT, Motions
from calib.adjust.hypotheses import Finding, ScoredFit, find_drifts
from calib.adjust.model_terms import candidate_terms, entering_together
from calib.adjust.result import BenchCalibration
from calib.adjust.terms import ImageTerm
from calib.adjust.uncertainty import check_weights, pixel_covariance
from calib.adjust.unknowns import ResidualBlock
from calib.calibrate import bench
from calib.calibrate.bench import BenchProblem, fit_bench
from calib.calibrate.starts.bench import BenchNotFitted, BenchStart, SomethingChanged, bench_start
from calib.calibrate.starts.views import view_poses
from calib.geometry.rig import Mast
from calib.geometry.significance import chance
from hil_tests.support.sim_survey.bench import (
    NAVCAMS,
    BenchCamera,
    BenchPlan,
    Mishap,
    Placement,
    simulate_bench,
)

SERVO: dict[str, Any] = {
    "pan_harmonics": ((0.004, 0.0045), (0.001, -0.0017)),
    "tilt_harmonics": ((0.003, -0.0052), (0.0015, 0.0013)),
    "backlash_rad": 0.004,
    "count_rad": 2 * np.pi / 4096,
}
"""Harmonics of 6 and 2 mrad, and a servo's counts."""

IN_SIGMAS = 4.5
"""How far anything of a test may be off."""


def errors_in_sigmas(plan: BenchPlan, fit: BenchCalibration, camera: str) -> np.ndarray:
    """Predicted less true pixels of points before the head, in sigmas."""
    off = []
    true = plan.cameras[camera]
    for reading in ((0.05, -0.4), (-0.8, -0.15), (0.7, 0.0)):
        angles = plan.rig.joints.true_rad(reading)
        model = plan.rig.camera_in_rover(camera, *angles)
        rays = model.ray(np.array([[200.0, 200.0], [512.0, 384.0], [800.0, 500.0]]))
        points = rays.origins_m + 1.5 * rays.directions
        truth = true.pixels(plan.mast.rover_from_head(*angles).inverse.points(points))
        assert true.on == "head"
        predicted, covariance = pixel_covariance(fit, camera, *fit.rig.joints.true_rad(reading), points)
        off.append((predicted - truth) / np.sqrt(np.einsum("nii->ni", covariance)))
    return np.array(off)


def test_a_head_without_errors_is_found_from_rough_focal_lengths_alone() -> None:
    plan = BenchPlan(attitudes=10)
    fit = fit_bench(simulate_bench(3, plan))
    assert not [t.name for t in fit.terms if t.entered]
    assert fit.chi2_probability > 1e-3
    assert all(1e-3 < drift.chance <= 1.0 for drift in fit.drifts)
    assert all(1e-3 < one.chance <= 1.0 for one in fit.contradictions)
    for name, truth in plan.cameras.items():
        assert np.abs(errors_in_sigmas(plan, fit, name)).max() < IN_SIGMAS
        assert fit.rms_px[name] == pytest.approx((0.1, 0.1), rel=0.1)
        assert fit.check_rms_px[name] == pytest.approx((0.1, 0.1), rel=0.2)
        off = fit.rig.cameras[name].model.C - np.array(truth.place_m)
        assert np.abs(off / np.array(fit.sigma["cameras"][name]["C"])).max() < IN_SIGMAS


def test_a_lens_of_opencvs_is_fitted_as_one_and_its_sigmas_hold() -> None:
    lens = (-0.12, 0.05, 0.004, -0.003, 0.01)
    cameras = {name: replace(camera, lens=lens) for name, camera in NAVCAMS.items()}
    plan = BenchPlan(attitudes=10, cameras=cameras)
    fit = fit_bench(simulate_bench(3, plan).as_model("OPENCV5"))
    assert fit.chi2_probability > 1e-3
    for name in plan.cameras:
        model, sigma = fit.rig.cameras[name].model, np.array(fit.sigma["cameras"][name]["distortion"])
        assert model.kind == "OPENCV5"
        assert np.abs((model.distortion - lens) / sigma).max() < IN_SIGMAS
        assert np.abs(errors_in_sigmas(plan, fit, name)).max() < IN_SIGMAS
        assert fit.check_rms_px[name] == pytest.approx((0.1, 0.1), rel=0.2)


def test_harmonics_backlash_and_bow_enter_and_say_what_they_gain() -> None:
    plan = BenchPlan(attitudes=16, bow_m=(0.002, -0.001), **SERVO)
    fit = fit_bench(simulate_bench(1, plan))
    entered = {t.name: t for t in fit.terms if t.entered}
    assert {"pan harmonic 1", "pan backlash", "tilt harmonic 1", "tilt backlash", "bow of b1"} <= set(entered)
    for name in {"axis offset", "axis twist"} & set(entered):
        assert "the pictures cannot exclude it" in entered[name].sentence
    for axis in ("pan", "tilt"):
        width = entered[f"{axis} backlash"]
        assert abs(width.values[0] - 0.004) < IN_SIGMAS * width.sigma[0]
        assert width.chi2 > 100 and width.chance < 1e-6
        assert "lowers chi-square" in width.sentence
    bow = entered["bow of b1"]
    assert np.abs((bow.values - plan.bow_m) / bow.sigma).max() < IN_SIGMAS
    # What matters of a joint is by how much the angle between two readings is off.
    for axis, low, high in (("pan", -0.9, -0.7), ("pan", 0.6, 0.9), ("tilt", -0.6, -0.3), ("tilt", 0.0, 0.2)):
        joint, true = getattr(fit.rig.joints, axis), getattr(plan.rig.joints, axis)
        readings = np.array([low, high])
        part = fit.part(f"joints.{axis}.")
        rates = np.diff(joint.rates(readings, 1), axis=0)[0]
        sigma = np.sqrt(rates @ fit.covariance[np.ix_(part, part)] @ rates)
        assert sigma < 4e-4
        off = np.diff(joint.true_rad(readings, 1)) - np.diff(true.true_rad(readings, 1))
        assert abs(off[0]) < IN_SIGMAS * sigma


def test_joint_readings_count_as_measurements_where_changes_are_looked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    freedoms: list[float] = []

    def chance(chi2: float, numbers: int, scale: float = 1.0, freedom: float = np.inf) -> float:
        freedoms.append(freedom)
        return 1.0

    monkeypatch.setattr(hypotheses, "chance", chance)
    fit = fit_bench(simulate_bench(1, BenchPlan(attitudes=10, **SERVO)))
    terms = sum(len(t.term.parameters) for t in fit.terms)
    # all terms are fitted then; readings without a number of their own would be some 70 fewer
    assert freedoms[0] == pytest.approx(fit.degrees_of_freedom, abs=terms)


@pytest.mark.long(3, "two whole fits of a bench; names of terms are tested quickly beside it")
def test_a_board_may_have_the_name_of_another_term() -> None:
    plan = BenchPlan(attitudes=16, bow_m=(0.002, -0.001), **SERVO)
    survey = simulate_bench(1, plan)
    survey = replace(survey, images=tuple(replace(i, tilt_approach=1) for i in survey.images))
    bows = {}
    for board in ("b1", "backlash", "harmonic 2"):
        renamed = replace(
            survey,
            boards={board: survey.boards["b1"]},
            images=tuple(replace(i, board=board) for i in survey.images),
        )
        fit = fit_bench(renamed)
        assert [note for note in fit.notes if "backlash" in note] == [
            note for note in fit.notes if note.startswith("tilt backlash is not fitted")
        ]
        (bows[board],) = (t for t in fit.terms if t.name == f"bow of {board}")
    for board, bow in bows.items():
        assert bow.entered
        np.testing.assert_allclose(bow.values, bows["b1"].values)
        assert bow.sentence == bows["b1"].sentence.replace("bow of b1", f"bow of {board}")


def test_pictures_that_the_start_doubts_come_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without five of sixteen standstills the rest predicts them to a few sigma, which corners share."""

    def doubting(images: list[ImageTerm], *rest: Any) -> BenchStart:
        start = bench_start(images, *rest)
        return start._replace(doubtful=frozenset(t.name for t in images if t.attitude in (1, 4, 6, 9, 13)))

    monkeypatch.setattr(bench, "bench_start", doubting)
    plan = BenchPlan(attitudes=8, checks=0, own_px=0.01, **{**SERVO, "count_rad": 5e-5})
    fit = fit_bench(simulate_bench(1, replace(plan, placements=plan.placements[:2])))
    assert [outlier.name for outlier in fit.outliers if outlier.kind == "image"] == []


def test_only_the_harmonics_of_one_joint_enter_together() -> None:
    groups = entering_together(candidate_terms(["harmonic left", "harmonic right", "pan", "x,y"]).values())
    assert [g for g in groups if len(g) > 1] == [
        ("pan harmonic 1", "pan harmonic 2"),
        ("tilt harmonic 1", "tilt harmonic 2"),
    ]


def test_skew_axes_enter_when_they_are_there() -> None:
    skew = Mast(np.zeros(3), np.zeros(3), 0.012, 0.006)
    fit = fit_bench(simulate_bench(2, BenchPlan(attitudes=10, mast=skew)))
    entered = {t.name: t for t in fit.terms if t.entered}
    assert set(entered) >= {"axis offset", "axis twist"}
    assert entered["axis offset"].values[0] == pytest.approx(0.012, abs=2e-4)
    assert entered["axis twist"].values[0] == pytest.approx(0.006, abs=2e-4)


def test_one_camera_is_enough() -> None:
    plan = BenchPlan(cameras={"eye": BenchCamera(turn_rad=(0.01, -0.02, 0.01))}, attitudes=12)
    fit = fit_bench(simulate_bench(4, plan))
    assert fit.rig.stereo == {}
    assert np.abs(errors_in_sigmas(plan, fit, "eye")).max() < IN_SIGMAS


def test_a_body_camera_hangs_on_boards_that_head_cameras_see() -> None:
    body = BenchCamera(
        on="rover", size_px=(640, 480), focal_px=(420.0, 421.0), centre_px=(322.0, 238.0), lens=(-0.05, 0.01),
        place_m=(0.2, 0.05, 0.6), turn_rad=(0.0, 0.15, 0.0),
    )  # fmt: skip
    plan = BenchPlan(
        cameras={**NAVCAMS, "hazcam": body},
        placements=(Placement(1.2, 0.0, -0.3), Placement(1.6, -0.2, -0.25, (0.3, 0.3, 0.0))),
        attitudes=10,
    )
    fit = fit_bench(simulate_bench(5, plan))
    off = fit.rig.cameras["hazcam"].model.C - np.array(body.place_m)
    assert np.abs(off / np.array(fit.sigma["cameras"]["hazcam"]["C"])).max() < IN_SIGMAS
    assert np.linalg.norm(off) < 0.003


def test_gross_corners_and_a_picture_of_something_else_are_left_out_and_named() -> None:
    plan = BenchPlan(attitudes=10, gross=0.015)
    survey = simulate_bench(6, plan)
    bad = survey.images[7].name
    corners = dict(survey.corners)
    rng = np.random.default_rng(1)
    corners[bad] = replace(corners[bad], pixels_px=rng.uniform(50, 700, corners[bad].pixels_px.shape))
    fit = fit_bench(replace(survey, corners=corners))
    assert f"image {bad}" in {o.name for o in fit.outliers}
    assert sum(o.kind == "dot" for o in fit.outliers) > 30
    assert all(" corner " in o.name for o in fit.outliers if o.kind == "dot")
    for name in plan.cameras:
        assert np.abs(errors_in_sigmas(plan, fit, name)).max() < IN_SIGMAS


@pytest.mark.parametrize(
    ("mishap", "words"),
    [
        pytest.param(
            Mishap("pan", 7, 0.02),
            r"pan slipped by about (19|20)\.",
            marks=pytest.mark.long(1, "a slip of twice the size; half of it is in the quick run"),
        ),
        (Mishap("pan", 8, 0.01), r"pan slipped by about (9\.9|10\.0|10\.1) mrad between .*-016 and .*-017"),
        (Mishap("tilt", 14, 0.004), "tilt slipped by about 4.0 mrad"),
        (
            Mishap("focus", 16, 0.01),
            r"on navcam_left is another camera \(focal length [+-](0\.9\d|1\.0\d) %, turned by 0\.",
        ),
        (
            Mishap("knock", 16, 0.004),
            r"navcam_left was knocked between pictures \S+ and \S+, and turned by about (3\.9|4\.0|4\.1) m",
        ),
        (Mishap("twin", 0, 0.4), "Two boards have the same ids"),
    ],
)
def test_what_changed_half_way_is_named_and_not_averaged(mishap: Mishap, words: str) -> None:
    survey = simulate_bench(2, BenchPlan(attitudes=10, gross=0.005, mishaps=(mishap,)))
    with pytest.raises(BenchNotFitted, match=words):
        fit_bench(survey)


def test_what_drifts_is_named_with_its_size_and_is_no_slip() -> None:
    """Pan by 0.5 mrad, and the right camera's focal length by 0.05 %, from the first picture to the last."""
    plan = BenchPlan(attitudes=8, checks=0, own_px=0.01, count_rad=5e-5)
    survey = simulate_bench(1, replace(plan, placements=plan.placements[:2]))
    images, corners = [], dict(survey.corners)
    centre_px = np.array(plan.cameras["navcam_right"].centre_px)
    for k, image in enumerate(survey.images):
        part = k / (len(survey.images) - 1)
        assert image.pan_rad is not None
        images.append(replace(image, pan_rad=image.pan_rad - 0.0005 * part))
        if image.camera == "navcam_right":
            seen = corners[image.name]
            wider = centre_px + (1 + 0.0005 * part) * (seen.pixels_px - centre_px)
            corners[image.name] = replace(seen, pixels_px=wider)
    fit = fit_bench(replace(survey, images=tuple(images), corners=corners))
    drifts = {drift.subject[1]: drift for drift in fit.drifts}
    assert drifts["pan"].values[0] == pytest.approx(0.0005, rel=0.15)
    assert drifts["navcam_right"].values[0] == pytest.approx(0.0005, rel=0.3)
    assert max(drifts["pan"].chance, drifts["navcam_right"].chance) < 1e-6 < drifts["tilt"].chance
    assert "pan drifts off its reading, by +0." in drifts["pan"].sentence
    # what the second placement says of the camera is not what the first one says
    assert fit.contradictions[0].chance < 1e-6


def test_a_drift_of_many_numbers_has_to_explain_more_than_a_change_of_few() -> None:
    def found(gain: float, numbers: int) -> Finding:
        values = np.full(numbers, 1e-4)
        return Finding("", (), "", values, values, numbers, gain, chance(gain, numbers), 0.01)

    assert not found(50.0, 4).likelier(found(45.0, 1))
    assert found(60.0, 4).likelier(found(45.0, 1))
    assert found(3100.0, 4).likelier(found(3000.0, 1))  # no float is as small as these chances
    assert not found(3000.0, 4).likelier(found(3100.0, 1))


def test_a_camera_without_a_picture_left_is_tested_for_no_drift() -> None:
    plan = BenchPlan(attitudes=8, checks=0)
    two = BenchProblem(simulate_bench(1, replace(plan, placements=plan.placements[:2])))
    problem = two.problem({}, two.start).without_unseen(two.start)
    left = [replace(t, keep=t.keep & (t.camera == "navcam_left")) for t in problem.images]
    drifts = find_drifts(ScoredFit(problem.with_terms(left, ()), two.start))
    assert {drift.subject[1] for drift in drifts} == {"pan", "tilt", "navcam_left"}


@pytest.mark.parametrize(("size_m", "at"), [(0.5, 6), (0.02, 8)])
def test_a_board_that_moved_is_named_with_the_pictures_between_which(size_m: float, at: int) -> None:
    survey = simulate_bench(2, BenchPlan(attitudes=10, mishaps=(Mishap("board", at, size_m),)))
    with pytest.raises(
        BenchNotFitted, match="board b1 moved during placement p1, between pictures"
    ) as caught:
        fit_bench(survey)
    assert not isinstance(caught.value, SomethingChanged)  # the other placements are good
    after = re.findall(r"and (\S+?)[,:]", str(caught.value))[0]
    shown = [image.name for image in survey.images if image.name in survey.corners]
    assert abs(shown.index(after) - 2 * at) <= 2


def test_a_print_less_exact_than_its_corners_are_found_is_weighed_and_not_refused() -> None:
    plan = BenchPlan(attitudes=10, own_px=0.01, print_m=1e-4)
    fit = fit_bench(simulate_bench(3, plan))
    assert fit.inexact_m == pytest.approx(1e-4, rel=0.25)
    for name in plan.cameras:
        seen_px, expected_px, most_px, _ = fit.checks[name]
        assert 0.03 < seen_px < most_px
        assert 0.7 < seen_px / expected_px < 1.4


def test_check_images_of_a_camera_share_the_error_of_its_calibration() -> None:
    """Three images of two corners hang on one unknown that moves each number by 1 px and is known to 0.5, and
    two of them on one reading, the third on another, which move theirs by 2 px; corners scatter by 0.1 px."""
    places, counts = np.zeros((2, 3)), np.arange(2)
    terms = [
        ImageTerm(
            f"image {k}", "left", ("b", "p"), -1, pan_rad, 0.0, counts, counts, places, places[:, :2],
            np.full(2, 0.1), np.ones(2, dtype=bool),
        )
        for k, pan_rad in enumerate((0.1, 0.1, 0.3))
    ]  # fmt: skip
    block = ResidualBlock(np.zeros(4), np.full((4, 1), 10.0), np.arange(1))  # in sigmas

    by_pan = np.full((4, 20), 1e4) * (np.arange(20) == PAN_TILT[0])
    reads = Motions(block, by_pan, np.zeros((4, 4)))
    exact = SimpleNamespace(motions=lambda state, terms: [reads] * len(terms))
    problem: Any = SimpleNamespace(exact=lambda: exact, joint_rad=0.002)
    state: Any = None
    shared = np.array([[0.5, 2.0, 0.0]] * 8 + [[0.5, 0.0, 2.0]] * 4)
    expected = np.sort(np.full(12, 0.01) + np.append(np.zeros(9), np.linalg.eigvalsh(shared.T @ shared)))
    np.testing.assert_allclose(
        np.sort(check_weights(problem, state, np.array([[0.25]]), terms)), expected, atol=1e-6
    )


def test_an_image_of_one_row_of_corners_fixes_nothing_and_harms_nothing() -> None:
    rows, columns = np.divmod(np.arange(40), 8)
    points = np.stack([columns, rows, 0 * rows], axis=-1) * 0.035
    lens = np.array([[1000.0, 0.0, 511.5], [0.0, 1000.0, 383.5], [0.0, 0.0, 1.0]])
    terms = []
    for k, turn in enumerate(([0.4, 0.0, 0.0], [0.0, 0.4, 0.1], [-0.3, 0.3, 0.0], [0.2, -0.4, 0.0])):
        some = rows == 0 if k == 2 else rows >= 0
        pixels = cv2.projectPoints(points, np.array(turn), np.array([-0.1, -0.05, 0.7]), lens, None)[0]
        terms.append(
            ImageTerm(
                str(k), "left", ("b", "p"), None, 0.0, 0.0, rows[some], columns[some], points[some],
                pixels[some, 0], np.full(some.sum(), 0.1), np.ones(some.sum(), dtype=bool),
            )
        )  # fmt: skip
    views = view_poses(terms, "CAHV", (1024, 768), 850.0)
    assert np.linalg.norm(np.cross(views.model.A, views.model.H)) == pytest.approx(1000.0, rel=0.01)


def test_corners_far_beyond_what_the_folder_allows_are_refused() -> None:
    survey = simulate_bench(3, BenchPlan(attitudes=10, own_px=0.01, corner_px=0.01, print_m=3e-4))
    with pytest.raises(BenchNotFitted, match=r"off one by one.*0\.06 px at most"):
        fit_bench(survey)
    assert fit_bench(simulate_bench(3, BenchPlan(attitudes=10, own_px=0.01))).inexact_m == 0.0


def test_a_joint_that_hardly_moves_is_named() -> None:
    survey = simulate_bench(1, BenchPlan(attitudes=8, reach_rad=(0.3, 0.01)))
    with pytest.raises(BenchNotFitted, match=r"tilt moves by 1.* at most while camera navcam_.* sees one"):
        fit_bench(survey)


def test_too_few_pictures_say_what_is_missing() -> None:
    survey = simulate_bench(1, BenchPlan(attitudes=3, checks=0, placements=(Placement(1.5),)))
    with pytest.raises(BenchNotFitted, match="3 head positions where 4 at least"):
        fit_bench(survey)
