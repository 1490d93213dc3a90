"""Which pair looks, and what poses mean: by hand, by SciPy, and by the rig's own cameras."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.errors import CalibError
from calib.files.mast_file import load_rig
from calib.geometry.pointing import choose
from calib.geometry.rig import Rig
from calib.geometry.rigid import Rigid
from mastctl.errors import MastctlError
from mastctl.motion.pairs import HandoffRules, PairBounds, choose_pairs
from mastctl.motion.track import LATE_S, RoverPose, check_follows, is_still, motion_between


@pytest.fixture(scope="module")
def rig(repository: Path) -> Rig:
    return load_rig(repository / "configs/sim/rocky8.yaml").rig


def ahead(range_m: float) -> np.ndarray:
    """A place on level ground, so far in front of the rover's origin."""
    return np.array([0.5 + range_m, 0.3, 0.0])


@pytest.mark.parametrize(("range_m", "pair"), [(9.0, "pancam"), (4.0, "navcam"), (1.0, "hazcam")])
def test_the_papers_pair_looks_at_each_range(rig: Rig, range_m: float, pair: str) -> None:
    assert choose_pairs(rig, ahead(range_m))[0].pair == pair


@pytest.mark.parametrize("range_m", [9.0, 4.0, 2.0])
def test_the_target_comes_midway_between_the_middles_of_both_pictures(rig: Rig, range_m: float) -> None:
    turned = [choice for choice in choose_pairs(rig, ahead(range_m)) if choice.true_rad is not None]
    assert {choice.pair for choice in turned} == {"pancam", "navcam"}
    for choice in turned:
        assert choice.true_rad is not None
        left, right = (rig.camera_in_rover(eye, *choice.true_rad) for eye in rig.stereo[choice.pair])
        off = [model.project(ahead(range_m))[0] - np.array(model.image_center_px) for model in (left, right)]
        assert np.abs(off[0] + off[1]).max() < 1.0


UNBOUNDED = {"pancam": PairBounds(), "navcam": PairBounds()}


def test_the_budget_decides_between_pairs_that_keep_their_bounds(rig: Rig) -> None:
    found = choose_pairs(rig, ahead(4.0), HandoffRules(pairs=UNBOUNDED))
    assert [choice.pair for choice in found] == ["pancam", "navcam", "hazcam"]
    errors = [choice.range_error_m for choice in found]
    # Eqs. (1) and (2) with 1 px: 4.1 m away and 1.48 m up, 3409 px by 0.3 m and 1288 px by 0.203 m.
    away_m = math.hypot(4.1, 1.48, 0.3)
    assert errors[:2] == pytest.approx([away_m**2 / (3409 * 0.2998), away_m**2 / (1288 * 0.2031)], rel=0.02)
    near = choose_pairs(rig, ahead(4.0), HandoffRules(pairs=UNBOUNDED, range_error=0.01))
    assert [choice.pair for choice in near if not choice.outside] == ["pancam"]
    assert "more than 0.01 of the range" in near[-1].outside


def test_a_pair_that_looks_down_too_steeply_hands_over(rig: Rig) -> None:
    rules = HandoffRules(pairs={"pancam": PairBounds(nearest_m=6.0), "navcam": PairBounds(steepest_rad=0.6)})
    assert choose_pairs(rig, ahead(2.2), rules)[0].pair == "navcam"
    found = choose_pairs(rig, ahead(1.5), rules)
    assert found[0].pair == "hazcam"
    assert "steeper than 0.6 rad" in next(one.outside for one in found if one.pair == "navcam")


def test_where_no_pair_keeps_its_bounds_the_shortest_focal_length_serves(rig: Rig) -> None:
    behind = np.array([-0.9, 0.2, 0.0])
    found = choose_pairs(rig, behind)
    assert found[0].pair == "navcam"
    assert "nearer than 2 m" in found[0].outside


def test_nobody_who_sees_it_is_told_camera_by_camera(rig: Rig) -> None:
    blind = replace(rig, stereo={"hazcam": rig.stereo["hazcam"]})
    with pytest.raises(CalibError, match=r"no stereo pair sees the target.*hazcam_left has it at pixel"):
        choose_pairs(blind, np.array([-1.5, 0.2, 0.0]))
    with pytest.raises(CalibError, match="beyond the limit"):
        choose_pairs(
            rig, np.array([-5.0, 0.2, 0.0]), chosen=lambda some: choose(some, (-1.0, 1.0), (-1.2, 0.5))
        )


def pose(
    time_s: float | None, x_m: float = 0.0, heading_rad: float = 0.0, received_s: float = 0.0
) -> RoverPose:
    turned = Rotation.from_euler("z", heading_rad).as_matrix()
    return RoverPose(Rigid(turned, np.array([x_m, 0.0, 0.0])), None, time_s, received_s)


@pytest.mark.parametrize(
    ("before_s", "now_s", "later_s"),
    [(5.0, 4.9, 0.0), (5.0, 5.0, 0.0), (5.0 + LATE_S, 5.0, 0.0), (5.0, 4.0, LATE_S - 1.1)],
)
def test_poses_come_in_order(before_s: float, now_s: float, later_s: float) -> None:
    with pytest.raises(MastctlError) as refused:
        check_follows(pose(now_s, received_s=100.0 + later_s), pose(before_s, received_s=100.0))
    assert refused.value.code == "pose_runs_backwards"
    check_follows(pose(5.1), pose(5.0))
    check_follows(pose(None), pose(5.0))
    check_follows(pose(1.0), None)


@pytest.mark.parametrize(
    ("before_s", "now_s", "later_s"),
    [
        (1e12, 17.5, 0.01),
        (5.0 + LATE_S, 4.99, 0.0),
        (5.0, 5.0, LATE_S + 0.01),
    ],
)
def test_a_pose_that_cannot_have_been_on_its_way_so_long_has_another_clock(
    before_s: float, now_s: float | None, later_s: float
) -> None:
    check_follows(pose(now_s, received_s=100.0 + later_s), pose(before_s, received_s=100.0))


def test_a_motion_is_where_the_frame_before_lies_in_the_one_of_now() -> None:
    motion = motion_between(pose(None), pose(None, 2.0, math.pi / 2))
    # After 2 m ahead and a quarter turn to the right, what was 3 m ahead is 1 m to the left.
    assert motion.points([3.0, 0.0, 0.0]) == pytest.approx([0.0, -1.0, 0.0])
    assert not is_still(motion)
    assert is_still(motion_between(pose(None), pose(None, 0.004, 0.0009)))
    assert not is_still(motion_between(pose(None), pose(None, 0.0, 0.0012)))
