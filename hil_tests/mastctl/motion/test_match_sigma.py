"""The short form of the campaign: what the loop's matches on rough ground are off by, of what they tell."""

from __future__ import annotations

import numpy as np
import pytest

from calib.files.mast_file import load_rig
from mastctl.packaged import config_folder
from tools.campaigns.match_sigma import MatchLook, MatchRow, Rows, run_look, together

TARGETS, SEEDS = 8, (1, 2)


def of_sigma(row: MatchRow) -> float:
    """Rms of error over told sigma along x, where ranges show."""
    return float(np.sqrt(np.mean((row.error_px / row.sigma_px)[:, 0] ** 2)))


def rows_on(relief_m: float) -> Rows:
    rig = load_rig(config_folder() / "masts" / "rocky8_simulated.yaml").rig
    return together([run_look(MatchLook(rig, relief_m, seed, 0, TARGETS)) for seed in SEEDS])


@pytest.mark.long(1, "a campaign in small: many rendered matches for one scatter")
def test_the_loops_matches_on_rough_ground_are_off_by_what_they_tell() -> None:
    found = rows_on(0.5)["the loop's", "other eye"]
    assert len(found.error_px) > TARGETS
    assert 0.4 < of_sigma(found) < 2.0
