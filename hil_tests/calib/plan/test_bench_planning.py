"""What a picture would show: against differences of the whole pointing, against shots that were taken."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.errors import CalibError
from calib.files.mast_file import load_rig
from calib.geometry.covariance import moved_rig
from calib.geometry.pointing import solve
from calib.geometry.rig import AxisJoint, JointErrors, Rig
from calib.geometry.stereo import triangulate
from calib.plan.knowledge import CLICKS, RANGES_M, BenchShot, Knowledge, Workspace, pointing
from calib.plan.placements import Placement, advise, first_placement
from calib.plan.poses import (
    Sought,
    candidates,
    expected_px,
    next_shot,
    rover_from_board,
    seen,
)
from calib.targets.boards import Charuco

BOARD = Charuco(10, 7, 0.055, 0.042)
PAIR = ("navcam_left", "navcam_right")
STEP_PARTS = 1e-6
CLOSE = 2e-3
"""Of the largest rate: what differences leave."""


@pytest.fixture(scope="module")
def rig(repository: Path) -> Rig:
    whole = load_rig(repository / "configs/sim/rocky8.yaml").rig
    cameras = {name: whole.cameras[name] for name in PAIR}
    joints = JointErrors(AxisJoint(((2e-3, -1e-3),), 3e-3), AxisJoint(((-1e-3, 4e-3),), 2e-3))
    mast = replace(whole.mast, axis_offset_m=0.004, axis_twist_rad=0.01)
    return replace(whole, mast=mast, cameras=cameras, stereo={"navcam": PAIR}, joints=joints)


def sought(one_sided: bool = False) -> Sought:
    return Sought(BOARD.in_board_m(BOARD.ids), 0.05, 8, (-2.6, 2.6), (-1.2, 0.5), one_sided)


def standing(rig: Rig, placement: Placement, name: str = "p1", joint_sigma_rad: float = 1e-5) -> Knowledge:
    pose = placement.rover_from_board(rig.mast.rover_from_head(0.0, 0.0))
    return Knowledge(rig, {name: pose}, joint_sigma_rad)


def test_pointing_rates_are_differences_between_rigs(rig: Rig) -> None:
    known = Knowledge(rig, {})
    where = Workspace(PAIR, (-0.7, 0.7), (-0.5, 0.1))
    aim = pointing(known, where)
    model = rig.cameras[PAIR[0]].model
    tried = 0
    for k, name in enumerate(known.names):
        scale = float(np.linalg.norm(model.H)) if name.split(".")[-2] in "HV" else 1.0
        step = STEP_PARTS * scale
        try:
            other = moved_rig(rig, [name], np.array([step]))
        except ValueError:
            continue
        landed = []
        approach = 0
        pans, tilts = np.linspace(-0.7, 0.7, 5), np.linspace(-0.5, 0.1, 3)
        for row, (pan, tilt, range_m, click) in enumerate(product(pans, tilts, RANGES_M, CLICKS)):
            approach = 1 if approach != 1 else -1
            if row % (5 if tried % 7 == 0 else 17) == 0:
                landed.append((row, _landed(rig, other, (pan, tilt), range_m, approach, click)))
        wanted = np.array([off for _, off in landed]) / step
        found = np.array([aim.to_rig[2 * r : 2 * r + 2, k] for r, _ in landed])
        size = max(np.abs(wanted).max(), 1.0)
        np.testing.assert_allclose(found, wanted, atol=CLOSE * size, err_msg=name)
        tried += 1
    assert tried >= 30


def _landed(
    true: Rig,
    believed: Rig,
    read: tuple[float, float],
    range_m: float,
    approach: int,
    click: tuple[float, float],
) -> np.ndarray:
    """Where the clicked point comes to lie, less the middle, if a rig that is none points at it."""
    sides = (approach, approach)
    model = true.cameras[PAIR[0]].model
    width, height = model.size_px
    here = true.joints.true_rad(read, sides)
    eyes = [true.camera_in_rover(name, *here) for name in PAIR]
    ray = eyes[0].ray(np.array([click[0] * width, click[1] * height]))
    point = ray.origins_m + range_m * ray.directions
    pixels = [eye.project(point)[0] for eye in eyes]
    seen = [believed.camera_in_rover(name, *believed.joints.true_rad(read, sides)) for name in PAIR]
    ranged = triangulate(seen[0], seen[1], *pixels).position_m
    left = believed.cameras[PAIR[0]].model
    angles = solve(
        believed.mast, left, ranged, model.image_center_px, from_pan_rad=read[0], from_tilt_rad=read[1]
    )
    back = (-approach, -approach)
    sent = believed.joints.read_rad((angles[0].pan_rad, angles[0].tilt_rad), back)
    there = true.camera_in_rover(PAIR[0], *true.joints.true_rad(sent, back))
    return np.asarray(there.project(point)[0] - model.image_center_px)


def test_each_shot_that_is_taken_leaves_less_and_as_much_as_was_expected(rig: Rig) -> None:
    known = standing(rig, Placement(1.2, 10.0, -5.0, (20.0, 0.0)))
    aim = pointing(known, Workspace(PAIR, (-0.9, 0.9), (-0.6, 0.1)))
    shots: list[BenchShot] = []
    left = np.inf
    for _ in range(5):
        choice = next_shot(known, sought(), shots, "p1", aim)
        assert choice is not None and choice.expected_px < left
        shots.append(choice.shot)
        left = expected_px(known, shots, aim)
        assert left == pytest.approx(choice.expected_px, rel=1e-6)


def test_no_other_attitude_would_tell_more_than_the_chosen_one(rig: Rig) -> None:
    known = standing(rig, Placement(1.2, 0.0, 0.0, (20.0, 0.0)))
    aim = pointing(known, Workspace(PAIR, (-0.9, 0.9), (-0.6, 0.1)))
    shots = [choice.shot for choice in [next_shot(known, sought(), [], "p1", aim)] if choice]
    best = next_shot(known, sought(), shots, "p1", aim)
    assert best is not None
    others = [expected_px(known, [*shots, one], aim) for one in candidates(known, sought(), shots, "p1")]
    assert best.expected_px <= min(others) + 1e-9


def test_a_few_shots_chosen_together_leave_less_than_one_after_the_other(rig: Rig) -> None:
    known = standing(rig, Placement(1.2, 10.0, -5.0, (20.0, 0.0)))
    aim = pointing(known, Workspace(PAIR, (-0.9, 0.9), (-0.6, 0.1), one_sided=True))
    left = []
    for count_ahead in (False, True):
        shots: list[BenchShot] = []
        for taken in range(5):
            ahead = 5 - taken if count_ahead else 1
            choice = next_shot(known, sought(True), shots, "p1", aim, ahead=ahead)
            assert choice is not None
            shots.append(choice.shot)
        assert len({(shot.pan_rad, shot.tilt_rad) for shot in shots}) == 5
        left.append(expected_px(known, shots, aim))
    assert left[1] < 0.9 * left[0]


def test_an_attitude_that_showed_no_board_is_not_tried_again(rig: Rig) -> None:
    known = standing(rig, Placement(1.2, 0.0, 0.0))
    aim = pointing(known, Workspace(PAIR, (-0.9, 0.9), (-0.6, 0.1)))
    first = next_shot(known, sought(), [], "p1", aim)
    assert first is not None
    avoid = [(first.shot.pan_rad, first.shot.tilt_rad)]
    second = next_shot(known, sought(), [], "p1", aim, avoid)
    assert second is not None
    assert max(abs(second.shot.pan_rad - avoid[0][0]), abs(second.shot.tilt_rad - avoid[0][1])) >= 0.02


def test_backlash_is_measured_from_both_sides_unless_one_is_chosen(rig: Rig) -> None:
    for one_sided, sides in ((False, {-1, 1}), (True, {0})):
        known = standing(rig, Placement(1.2, 0.0, 0.0, (20.0, 0.0)))
        aim = pointing(known, Workspace(PAIR, (-0.9, 0.9), (-0.6, 0.1), one_sided=one_sided))
        shots: list[BenchShot] = []
        for _ in range(6):
            choice = next_shot(known, sought(one_sided), shots, "p1", aim)
            assert choice is not None
            shots.append(choice.shot)
        assert {shot.pan_approach for shot in shots} == sides


def test_a_second_placement_is_requested_where_it_adds_more(rig: Rig) -> None:
    first = first_placement(Knowledge(rig, {}), sought(True))
    known = standing(rig, first)
    aim = pointing(known, Workspace(PAIR, (-0.9, 0.9), (-0.6, 0.1), one_sided=True))
    shots: list[BenchShot] = []
    for _ in range(8):
        choice = next_shot(known, sought(True), shots, "p1", aim)
        assert choice is not None
        shots.append(choice.shot)
    advice = advise(known, sought(True), shots, aim, most=40)
    assert advice is not None and advice.expected_px < 0.7 * choice.expected_px


def test_a_placement_says_in_words_where_it_puts_the_board(rig: Rig) -> None:
    placement = Placement(1.5, 30.0, -10.0, (25.0, 0.0))
    assert str(placement) == (
        "30 degrees right, 10 degrees below the head's height, 1.5 m away, turned 25 degrees to the right"
    )
    head = rig.mast.rover_from_head(0.0, 0.0)
    pose = head.inverse @ placement.rover_from_board(head)
    _, y, z = pose.translation_m
    assert y > 0.0 and z > 0.0  # to the right, and below
    assert np.linalg.norm(pose.translation_m) == pytest.approx(1.5)
    to_head = -pose.translation_m / 1.5
    right_of_sight = np.cross([0.0, 0.0, 1.0], -to_head)
    assert -pose.rotation[:, 2] @ right_of_sight > 0.3  # its face looks to the right
    assert pose.rotation[2, 1] > 0.9  # its lower edge is down


def test_a_board_is_placed_from_one_picture_where_opencv_drew_it(rig: Rig) -> None:
    model = rig.cameras["navcam_left"].model
    head = rig.mast.rover_from_head(0.3, -0.2)
    pose = Placement(1.3, 17.0, -11.0, (20.0, 10.0)).rover_from_board(head)
    points = BOARD.in_board_m(BOARD.ids)
    pixels, valid = model.project(head.inverse.points(pose.points(points)))
    assert valid.all()
    found = rover_from_board(rig, "navcam_left", 0.3, -0.2, points, pixels)
    np.testing.assert_allclose(found.translation_m, pose.translation_m, atol=1e-4)
    turn = Rotation.from_matrix(found.rotation.T @ pose.rotation).magnitude()
    assert turn < 1e-3
    with pytest.raises(CalibError, match="corners"):
        rover_from_board(rig, "navcam_left", 0.3, -0.2, points[:3], pixels[:3])


def test_information_from_body_cameras_counts_in_the_choice_of_attitudes(
    repository: Path,
) -> None:
    rig = replace(load_rig(repository / "configs/sim/rocky8.yaml").rig, provenance={})
    low = Placement(1.4, 0.0, -40.0, (10.0, 0.0))
    known, where = standing(rig, low), sought(one_sided=True)
    shots = [seen(known, where, BenchShot("p1", pan, -0.7 + pan, ())) for pan in (-0.2, 0.0, 0.25)]
    shots = [shot for shot in shots if shot is not None]
    assert {"hazcam_left", "navcam_left"} <= {view.camera for shot in shots for view in shot.views}
    aim = pointing(known, Workspace(PAIR, (-0.7, 0.7), (-0.5, 0.1), one_sided=True))
    choice = next_shot(known, where, shots, "p1", aim)
    assert choice is not None and not any("hazcam" in view.camera for view in choice.shot.views)
    of_head = [
        replace(shot, views=tuple(v for v in shot.views if "hazcam" not in v.camera)) for shot in shots
    ]
    alone = next_shot(known, where, of_head, "p1", aim)
    assert alone is not None and choice.expected_px < alone.expected_px
