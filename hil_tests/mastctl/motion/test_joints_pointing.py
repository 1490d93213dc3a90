"""What joint terms in the mast file are worth through a whole daemon, on a 12-bit head whose gears err."""

from __future__ import annotations

import numpy as np
import pytest

from tools.campaigns.sweep import Variant, point, sweep_named

HALF_COUNT_PX = 0.5 * 2 * np.pi / 4096 * 1290
OTHER_PX = 0.4
"""The packaged calibration, the match and the arm's sag."""


@pytest.mark.long(1, "a campaign in small: rendered pointings of two rovers")
def test_joints_in_the_mast_file_leave_what_counts_allow() -> None:
    packaged, cases = sweep_named("joints")
    found = {}
    for name in ("joints in the mast file", "joints not in the mast file"):
        done = [point(Variant(packaged, name, cases[name], 10.0, index, 1)) for index in range(2)]
        records = [record for one in done for record in one.records]
        assert [record.error for record in records] == ["", ""]
        found[name] = np.abs([record.landings[0].true_px for record in records]).max()
    assert found["joints in the mast file"] < HALF_COUNT_PX + OTHER_PX
    assert found["joints not in the mast file"] > 2.0 * (HALF_COUNT_PX + OTHER_PX)
