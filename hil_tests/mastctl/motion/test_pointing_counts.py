"""What the record of a pointing says about the counts of a head that knows them."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from calib.files.mast_file import load_rig
from drivers.interfaces import AxisReport
from mastctl.motion.steps import counts_left

COUNT_RAD = math.tau / 4096


class Counting:
    """A head of 12-bit servos that stands 0.4 counts beside the commanded pan."""

    def report(self) -> dict[str, AxisReport]:
        def axis(commanded: float | None, counts: int) -> AxisReport:
            angle = (counts - 2048) * COUNT_RAD
            return AxisReport(commanded, counts, angle, counts, angle, "positive", None, None, None, None)

        return {"pan": axis(100.4 * COUNT_RAD, 2148), "tilt": axis(None, 2000)}


def test_counts_and_the_pixels_that_they_leave(repository: Path) -> None:
    model = load_rig(repository / "configs" / "sim" / "rocky8.yaml").rig.cameras["navcam_left"].model
    told = counts_left(Counting(), 0.3, model)["counts"]
    assert told["pan"]["goal_counts"] == told["pan"]["measured_counts"] == 2148
    assert told["pan"]["came_from"] == "positive"
    assert told["pan"]["left_rad"] == pytest.approx(-0.4 * COUNT_RAD, abs=1e-7)
    # One 12-bit count is 1.96 pixels of the navigation camera (f = 1280 px): 1280 tan(0.0879 deg).
    assert told["pan"]["left_px"] == pytest.approx(-0.4 * 1.96 * math.cos(0.3), abs=0.01)
    assert "left_rad" not in told["tilt"]  # nothing was commanded
