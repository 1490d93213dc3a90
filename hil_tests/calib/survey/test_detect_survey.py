"""Dots of a whole survey folder: what is expected where, by which workers, and what is said of bad files."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.files.mast_file import load_rig
from calib.survey.find_dots import detect_survey, expectations
from calib.survey.records import Survey
from calib.targets.dots import PredictedBoard, Upright
from hil_tests.calib.targets.boards import gravel
from hil_tests.support.sim_survey.board import draw_board, photograph
from hil_tests.support.sim_survey.plan import Ring, SurveyPlan
from hil_tests.support.sim_survey.survey import simulate_survey

RMS_PX = 0.03
PICTURES = 6
ROUGH_RAD = np.radians(12)


@pytest.fixture(scope="module")
def drawn(repository: Path, tmp_path_factory: pytest.TempPathFactory):
    """A survey with a few pictures of all cameras on a body and a head, and where dots truly are."""
    rig = load_rig(repository / "configs" / "sim" / "rocky8.yaml").rig
    plan = SurveyPlan(rings=(Ring("hazcam", 1.5, 1),), mast_boards=2, check_boards=0)
    survey, truth = simulate_survey(rig, 5, plan)
    folder = tmp_path_factory.mktemp("survey")
    rng = np.random.default_rng(6)
    images, true_px = [], {}
    by_camera = sorted(survey.images, key=lambda image: (image.camera not in ("hazcam_left",), image.row))
    for image in by_camera[:PICTURES]:
        camera = rig.cameras[image.camera]
        pan_rad, tilt_rad = truth.joints_rad[image.name]
        model = rig.camera_in_rover(image.camera, pan_rad, tilt_rad) if camera.on == "head" else camera.model
        board = truth.rover_from_board[image.setup, image.placement]
        picture = draw_board(gravel(rng, model.size_px), model, board, survey.board)
        cv2.imwrite(str(folder / f"{image.name}.png"), photograph(picture, 0.7, 2.0, rng))
        images.append(replace(image, file=Path(f"{image.name}.png")))
        rows, columns = (a.ravel() for a in np.mgrid[0:10, 0:10])
        true_px[image.name] = model.project(board.points(survey.board.dots_in_board_m(rows, columns)))[0]
    return replace(survey, folder=folder, images=tuple(images), dots={}), true_px, (rig, truth)


def without_rough(survey: Survey) -> Survey:
    cameras = {n: replace(c, rough_C_m=None, rough_A=None) for n, c in survey.cameras.items()}
    return replace(survey, cameras=cameras)


@pytest.mark.parametrize("rough", [True, False])
def test_every_picture_gives_its_dots_in_their_order(drawn, rough: bool) -> None:
    survey, true_px, _ = drawn
    found = detect_survey(survey if rough else without_rough(survey))
    assert not found.failures and list(found.dots) == [image.name for image in survey.images]
    for name, dots in found.dots.items():
        errors = dots.pixels_px - true_px[name][10 * dots.rows + dots.columns]
        assert len(dots.rows) == 100 and np.sqrt(np.mean(errors**2)) < RMS_PX, name


def test_workers_give_the_same_and_report_how_far_they_are(drawn) -> None:
    survey, _, _ = drawn
    here, calls = detect_survey(survey), []
    with ProcessPoolExecutor(2) as executor:
        there = detect_survey(survey, executor, lambda done, of, image: calls.append((done, of, image)))
    assert [(done, of) for done, of, _ in calls] == [(k + 1, PICTURES) for k in range(PICTURES)]
    assert {image for _, _, image in calls} == set(here.dots)
    for name, dots in here.dots.items():
        assert np.array_equal(there.dots[name].pixels_px, dots.pixels_px)


def test_predictions_are_as_good_as_rough_cameras_are(drawn) -> None:
    survey, _, (rig, truth) = drawn
    for name, expected in expectations(survey).items():
        image = next(image for image in survey.images if image.name == name)
        assert isinstance(expected, PredictedBoard)
        turn = (
            expected.frame_from_board.rotation.T
            @ truth.rover_from_board[image.setup, image.placement].rotation
        )
        assert Rotation.from_matrix(turn).magnitude() < 0.02
        joints = truth.joints_rad[name]
        true = rig.camera_in_rover(image.camera, *joints)
        assert np.arccos(expected.camera.A @ true.A) < ROUGH_RAD + 0.05, name
        assert np.linalg.norm(expected.camera.C - true.C) < 0.3, name


def test_dots_that_are_there_are_kept_and_not_searched(drawn) -> None:
    survey, _, _ = drawn
    first = survey.images[0].name
    mine = detect_survey(replace(survey, images=survey.images[:1])).dots[first]
    again = detect_survey(
        replace(survey, images=survey.images[:1], dots={first: mine}, folder=Path("nowhere"))
    )
    assert again.dots[first] is mine


def test_files_that_cannot_be_used_are_failures_of_their_image_alone(drawn, tmp_path: Path) -> None:
    survey, _, _ = drawn
    one, two, three, four = survey.images[-4:]
    (tmp_path / one.file).write_bytes((survey.folder / one.file).read_bytes())
    (tmp_path / two.file).write_bytes(b"no picture")
    cv2.imwrite(str(tmp_path / three.file), np.zeros((48, 64), dtype=np.uint8))
    found = detect_survey(replace(survey, folder=tmp_path, images=(one, two, three, four)))
    assert list(found.dots) == [one.name]
    assert "is not a picture" in found.failures[two.name]
    assert "64 x 48 px where 1024 x 768 are expected" in found.failures[three.name]
    assert "cannot be read" in found.failures[four.name]


def test_without_tapes_nothing_is_expected_and_without_rough_the_upright(drawn) -> None:
    survey, _, _ = drawn
    prisms = tuple(point for point in survey.station if point.kind == "prism")
    assert set(expectations(replace(survey, station=prisms)).values()) == {None}
    upright = expectations(without_rough(survey))
    assert all(isinstance(expected, Upright) for expected in upright.values())
    for name, expected in upright.items():
        image = next(image for image in survey.images if image.name == name)
        size_px = survey.cameras[image.camera].size_px
        assert isinstance(expected, Upright)
        # z ahead through the middle of the picture, x to its right, y down: nothing else is known
        middle = [(n - 1) / 2 for n in size_px]
        ray = expected.camera.ray(np.array([middle, [middle[0] + 9, middle[1]], [middle[0], middle[1] + 9]]))
        assert np.allclose(ray.directions[0], [0, 0, 1], atol=1e-9)
        assert ray.directions[1, 0] > 0 and abs(ray.directions[1, 1]) < 1e-9
        assert ray.directions[2, 1] > 0 and abs(ray.directions[2, 0]) < 1e-9
