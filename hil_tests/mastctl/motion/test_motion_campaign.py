"""What tools/campaigns/motion.py counts as a lie: by the simulator's joints, not by what an encoder says."""

from __future__ import annotations

import numpy as np
import pytest

from calib.matching.same_patches import Posed
from tools.campaigns.motion import WalkView, is_lie, taken

NAME = "navcam_left"


@pytest.mark.parametrize(("true_pan_rad", "lie"), [(0.002, False), (0.02, True), (-0.02, True)])
def test_a_lie_is_told_from_the_true_joints(true_pan_rad: float, lie: bool) -> None:
    told = Posed(np.zeros((8, 8), np.float32), 0.0, -0.4)
    assert is_lie(WalkView({NAME: told}, (true_pan_rad, -0.4)), told, (0.008, 0.008)) is lie


def test_with_a_head_that_has_backlash_the_true_joints_are_not_the_readings() -> None:
    views = taken(1, 1, "dynamixel_x")
    off = [np.abs(np.subtract(view.true_rad, view.pictures[NAME].angles_rad)).max() for view in views]
    assert 1e-4 < max(off) < 0.02
