"""The simulated survey: what it measures is true up to the stated noise, and it can be written down."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.files.mast_file import load_rig
from calib.geometry.rig import Rig
from calib.geometry.rigid import Rigid
from calib.survey.reader import read_survey
from calib.survey.records import Sigma, Survey
from calib.survey.writer import write_survey
from tools.sim_survey.blunders import (
    with_moved_tape,
    with_outlier_dots,
    with_swapped_boards,
    with_wrong_prism,
)
from tools.sim_survey.plan import Ring, SurveyPlan, SurveyTruth
from tools.sim_survey.survey import simulate_survey

ROOT = Path(__file__).resolve().parents[2]
RIG_FILE = ROOT / "configs/sim/rocky8.yaml"


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(RIG_FILE).rig


@pytest.fixture(scope="module")
def simulated(rig: Rig) -> tuple[Survey, SurveyTruth]:
    return simulate_survey(rig, 1)


def test_the_papers_plan(simulated: tuple[Survey, SurveyTruth]) -> None:
    survey, _ = simulated
    count = Counter((image.camera, image.purpose) for image in survey.images)
    for name in ("pancam_left", "navcam_right", "hazcam_left"):
        assert count[name, "camera"] == 8
    assert count["navcam_left", "mast"] == 8
    assert count["pancam_right", "mast"] >= 3
    assert count["navcam_left", "check"] == 4
    assert count["hazcam_right", "check"] == 2
    assert 70 <= len(survey.images) <= 100
    assert {image.tilt_rad for image in survey.images if image.purpose == "camera"} == {
        None,
        np.radians(-5),
        np.radians(-10),
    }
    mast = [image for image in survey.images if image.purpose == "mast"]
    assert np.ptp([image.pan_rad for image in mast]) > 1.4
    assert np.ptp([image.tilt_rad for image in mast]) > 0.5
    assert {image.setup for image in survey.images if image.camera == "hazcam_left"} == {"tilted-back"}


@pytest.mark.parametrize("seed", range(5))
def test_every_seed_gives_whole_boards_above_the_ground(rig: Rig, seed: int) -> None:
    survey, truth = simulate_survey(rig, seed)
    seen = Counter((image.setup, image.placement) for image in survey.images)
    assert set(seen) == set(truth.rover_from_board), "no board was put up for nothing"
    for (setup, _), pose in truth.rover_from_board.items():
        half = 0.46
        corners = [(x, y, 0.0) for x in (-half, half) for y in (-half, half)]
        lowest_m = (truth.site_from_rover[setup] @ pose).points(corners)[:, 2].max()
        assert lowest_m < -0.04
    for image in survey.images:
        dots = survey.dots[image.name]
        assert len(dots.rows) == 100
        assert (dots.pixels_px > 3).all()
        assert (dots.pixels_px < np.array(survey.cameras[image.camera].size_px) - 4).all()


def test_without_noise_everything_agrees_with_the_mast_of_the_contract(rig: Rig) -> None:
    """Dots, tapes and prisms against Rig.camera_in_rover, whose kinematics is written elsewhere."""
    survey, truth = simulate_survey(rig, 2, SurveyPlan(noise=0.0, sigma=Sigma(0.001, 0.1, 0.001, 0.002)))
    worst_px = 0.0
    for image in survey.images:
        camera = rig.camera_in_rover(image.camera, image.pan_rad or 0.0, image.tilt_rad or 0.0)
        dots = survey.dots[image.name]
        in_board = survey.board.dots_in_board_m(dots.rows, dots.columns)
        pixels, valid = camera.project(truth.rover_from_board[image.setup, image.placement].points(in_board))
        assert valid.all()
        worst_px = max(worst_px, float(np.abs(pixels - dots.pixels_px).max()))
    assert worst_px < 1e-8
    for point in survey.station:
        if point.kind == "prism":
            there = survey.prisms_in_rover_m[point.point]
        else:
            tape = survey.board.tapes_in_board_m[point.point]
            there = truth.rover_from_board[point.setup, point.placement].points(tape)
        seen = truth.rover_from_station[point.setup].points(point.position_m)
        assert np.allclose(seen, there, atol=1e-12)


def test_noise_is_as_stated_and_changes_no_pose(rig: Rig) -> None:
    sigma = Sigma(0.002, 0.3, 0.0005, 0.004)
    noisy, truth = simulate_survey(rig, 3, SurveyPlan(sigma=sigma))
    exact, same = simulate_survey(rig, 3, SurveyPlan(sigma=sigma, noise=0.0))
    assert all(
        np.array_equal(truth.rover_from_board[k].rotation, p.rotation)
        for k, p in same.rover_from_board.items()
    )
    assert [i.pan_rad for i in noisy.images] == [i.pan_rad for i in exact.images]
    station = [
        truth.rover_from_station[a.setup].points(a.position_m)
        - same.rover_from_station[b.setup].points(b.position_m)
        for a, b in zip(noisy.station, exact.station, strict=True)
        if a.kind == "tape"
    ]
    assert np.std(station) == pytest.approx(0.002, rel=0.12)
    body = [i.name for i in exact.images if i.camera.startswith("hazcam")]
    dots = [noisy.dots[name].pixels_px - exact.dots[name].pixels_px for name in body]
    assert np.std(dots) == pytest.approx(0.3, rel=0.03)
    joints = np.array(
        [
            np.subtract(truth.joints_rad[i.name], (i.pan_rad, i.tilt_rad))
            for i in noisy.images
            if i.pan_rad is not None
        ]
    )
    assert np.std(np.unique(joints.round(12), axis=0)) == pytest.approx(0.0005, rel=0.35)
    drawing = [truth.prisms_in_rover_m[name] - place for name, place in noisy.prisms_in_rover_m.items()]
    assert 0.001 < np.std(drawing) < 0.009


def test_same_seed_same_survey(rig: Rig, simulated: tuple[Survey, SurveyTruth]) -> None:
    again, _ = simulate_survey(rig, 1)
    other, _ = simulate_survey(rig, 2)
    first = simulated[0].images[5].name
    assert np.array_equal(simulated[0].dots[first].pixels_px, again.dots[first].pixels_px)
    assert not np.array_equal(simulated[0].station[0].position_m, other.station[0].position_m)


def test_what_is_known_beforehand_is_rough_and_close(simulated: tuple[Survey, SurveyTruth]) -> None:
    survey, truth = simulated
    for name, camera in survey.cameras.items():
        model = truth.rig.cameras[name].model
        focal_px = np.linalg.norm(np.cross(model.A, model.H))
        assert abs(camera.focal_px / focal_px - 1) < 0.06
        first = next(image for image in survey.images if image.camera == name)
        there = truth.rig.camera_in_rover(name, first.pan_rad or 0.0, first.tilt_rad or 0.0)
        assert 0.001 < np.linalg.norm(camera.rough_C_m - there.C) < 0.2
        assert np.degrees(np.arccos(camera.rough_A @ there.A)) < 10


def test_a_plan_can_ask_for_less(rig: Rig) -> None:
    plan = SurveyPlan(
        rings=(Ring("navcam", 3.0, boards=3, head_tilt_rad=-0.2), Ring("mastcam", 3.0)),
        mast_boards=5,
        check_boards=0,
        attitudes=2,
        level_setups=2,
        prisms=3,
        rough=False,
    )
    survey, truth = simulate_survey(rig, 4, plan)
    assert list(survey.prisms_in_rover_m) == ["p1", "p2", "p3"]
    assert set(truth.rover_from_station) == {"level", "level-2"}
    assert not any(image.camera.startswith("hazcam") for image in survey.images)
    count = Counter((image.camera, image.purpose) for image in survey.images)
    assert count["navcam_left", "camera"] == 3
    assert count["navcam_left", "mast"] == 10
    assert survey.cameras["navcam_left"].rough_C_m is None


def test_a_pair_on_the_head_may_see_the_boards_of_one_on_the_body(rig: Rig) -> None:
    ring = Ring("hazcam", 1.5, boards=4)
    alone, together = (
        simulate_survey(rig, 2, SurveyPlan(rings=(replace(ring, also=also),), mast_boards=0, check_boards=0))[
            0
        ]
        for also in ("", "navcam")
    )
    assert {image.camera for image in alone.images} == {"hazcam_left", "hazcam_right"}
    boards = {image.placement for image in alone.images}
    turned = [image for image in together.images if image.camera.startswith("navcam")]
    assert {image.placement for image in turned} <= boards
    assert len(turned) >= 4, "most boards are seen whole"
    for image in turned:
        assert image.purpose == "mast"
        assert image.tilt_rad is not None and image.tilt_rad < -0.5, "the head looks down to them"


def test_truth_places_the_board_before_its_camera(simulated: tuple[Survey, SurveyTruth]) -> None:
    survey, truth = simulated
    for image in survey.images[::11]:
        model, pose = truth.camera_from_board(survey, image.name)
        dots = survey.dots[image.name]
        pixels, _ = model.project(pose.points(survey.board.dots_in_board_m(dots.rows, dots.columns)))
        assert np.abs(pixels - dots.pixels_px).max() < 0.6


def test_it_can_be_written_and_read(tmp_path: Path, simulated: tuple[Survey, SurveyTruth]) -> None:
    survey, _ = simulated
    written = write_survey(survey, tmp_path / "survey")
    assert {n: d.pixels_px.tolist() for n, d in written.dots.items()} == {
        n: d.pixels_px.tolist() for n, d in survey.dots.items()
    }
    assert [vars(i) for i in written.images] == [vars(i) for i in survey.images]


def test_blunders_change_what_they_say_and_nothing_else(simulated: tuple[Survey, SurveyTruth]) -> None:
    survey, _ = simulated
    shift = np.array([0.0, 0.03, 0.0])
    moved = with_moved_tape(survey, "level", "mast-1", "b", shift)
    wrong = with_wrong_prism(survey, "level", "p2", shift)
    for changed, point in ((moved, "b"), (wrong, "p2")):
        differences = [
            (b.point, b.position_m - a.position_m)
            for a, b in zip(survey.station, changed.station, strict=True)
            if not np.array_equal(a.position_m, b.position_m)
        ]
        assert [name for name, _ in differences] == [point]
        assert np.allclose(differences[0][1], shift)
    swapped = with_swapped_boards(survey, "level", "mast-1", "mast-2")
    where = {(p.placement, p.point): p.position_m for p in survey.station}
    for point in swapped.station:
        name = {"mast-1": "mast-2", "mast-2": "mast-1"}.get(point.placement, point.placement)
        if point.kind == "tape":
            assert np.array_equal(point.position_m, where[name, point.point])
    image = survey.images[0].name
    spoiled, chosen = with_outlier_dots(survey, image, 3, 5.0, np.random.default_rng(1))
    distance = np.linalg.norm(spoiled.dots[image].pixels_px - survey.dots[image].pixels_px, axis=1)
    assert sorted(np.round(distance[distance > 0], 9)) == [5.0] * 3
    assert len(set(chosen)) == 3
    with pytest.raises(KeyError, match="mast-99"):
        with_moved_tape(survey, "level", "mast-99", "b", shift)
    with pytest.raises(KeyError, match="nowhere"):
        with_swapped_boards(survey, "level", "mast-1", "nowhere")


def test_the_command_writes_a_folder_and_never_over_it(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tools.simulated.survey", "--rig", str(RIG_FILE)]
    out = tmp_path / "survey"
    arguments = [*command, "--out", str(out), "--mast-boards", "3", "--check-boards", "0", "--seed", "5"]
    done = subprocess.run(arguments, capture_output=True, text=True, check=True, cwd=ROOT)
    assert read_survey(out).digest[:12] in done.stdout
    again = subprocess.run(arguments, capture_output=True, text=True, check=False, cwd=ROOT)
    assert again.returncode == 2
    assert "not empty" in again.stderr


def test_rendered_pictures_show_the_dots(rig: Rig) -> None:
    """The mean of dark pixels around a dot is where the dot was noted, within its noise."""
    import cv2

    from tools.simulated import survey as command

    plan = SurveyPlan(rings=(Ring("navcam", 3.0, 1, -0.2),), mast_boards=0, check_boards=0, noise=0.0)
    survey, truth = simulate_survey(rig, 6, plan)
    assert truth.site_from_rover["level"] == Rigid.identity()
    one = replace(survey, images=survey.images[:1])
    [(name, data)] = command.pictures(one, truth, 6, plain=True)
    picture = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_GRAYSCALE).astype(float)
    assert name == survey.images[0].file.as_posix()
    errors = []
    for x, y in survey.dots[survey.images[0].name].pixels_px:
        left, top = round(x) - 13, round(y) - 13
        dark = np.clip(180.0 - picture[top : top + 27, left : left + 27], 0, None)
        rows, columns = np.mgrid[top : top + 27, left : left + 27]
        errors.append(((dark * columns).sum() / dark.sum() - x, (dark * rows).sum() / dark.sum() - y))
    assert np.abs(errors).max() < 0.25
    assert np.abs(np.mean(errors, axis=0)).max() < 0.05
