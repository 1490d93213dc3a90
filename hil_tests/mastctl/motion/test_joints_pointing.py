"""What joint terms are worth through a whole daemon: a 12-bit head whose encoders and gears err."""

from __future__ import annotations

import numpy as np
import pytest

from tools.campaigns.joints import CASES, JointsTask, point

HALF_COUNT_PX = 0.5 * 2 * np.pi / 4096 * 1290
OTHER_PX = 0.4
"""The packaged calibration, the match and the arm's sag."""


@pytest.mark.long(1, "a campaign in small: a bench, its fit and pointings")
def test_with_joints_told_the_first_pointing_lands_within_what_counts_allow() -> None:
    told, not_told = (point(JointsTask(case, 10.0, 2, 1)) for case in CASES[1:3])
    assert not told.errors and len(told.first_px) == 2
    assert np.abs(told.first_px).max() < HALF_COUNT_PX + OTHER_PX
    assert np.abs(not_told.first_px).max() > 2.0 * (HALF_COUNT_PX + OTHER_PX)
