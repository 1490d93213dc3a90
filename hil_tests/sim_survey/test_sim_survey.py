"""The simulated survey: what it measures is true up to the stated noise, and it can be written down."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.files.mast_file import load_rig
from calib.geometry.rig import Rig
from calib.geometry.rigid import Rigid
from calib.survey.records import Sigma
from hil_tests.support.sim_survey.plan import Ring, SurveyPlan
from hil_tests.support.sim_survey.survey import simulate_survey
from tools.simulated import survey as command

ROOT = Path(__file__).resolve().parents[2]
RIG_FILE = ROOT / "configs/sim/rocky8.yaml"


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(RIG_FILE).rig


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


def test_rendered_pictures_show_the_dots(rig: Rig) -> None:
    """The mean of dark pixels around a dot is where the dot was noted, within its noise."""
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
