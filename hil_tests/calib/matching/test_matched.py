"""What is kept of a hand-off that was looked up: where each camera was to see it, and where it does."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest

from calib.files.mast_file import load_rig
from calib.geometry.handoff import Joints, hand_off
from calib.matching.handoff import MatchedHandoff, RefinedPixel, matched_handoff
from hil_tests.calib.matching.handed_over import NAVCAMS, pixel, plain_rig, vectors

AT = Joints(0.1, -0.6)
FOUND_PX = np.array([400.0, 300.0])
NOWHERE = np.full(2, np.nan)
REFINED = {
    "hazcam_left": RefinedPixel("accepted", "", FOUND_PX, 0.01 * np.eye(2), np.zeros(2)),
    "hazcam_right": RefinedPixel("flat", "too little texture", NOWHERE, np.full((2, 2), np.nan), NOWHERE),
}


@pytest.fixture(scope="module")
def record(repository: Path) -> MatchedHandoff:
    rig = plain_rig(load_rig(repository / "configs/sim/rocky8.yaml").rig)
    target = np.array([2.5, 0.25, -0.1])
    clicks = np.array([pixel(vectors(rig, name, AT.pan_rad, AT.tilt_rad), target) for name in NAVCAMS])
    to = (*REFINED, "navcam_left")
    done = hand_off(rig, NAVCAMS, to, AT, *clicks, sigma_px=0.3)
    when = datetime(2026, 3, 1, 1, 30, 0, 250_400, tzinfo=timezone(timedelta(hours=2)))
    return matched_handoff("d" * 64, NAVCAMS, AT, clicks.tolist(), 0.3, AT, done, REFINED, when)


def test_only_what_was_accepted_is_kept_as_found(record: MatchedHandoff) -> None:
    left, right = (record.landed[name] for name in REFINED)
    np.testing.assert_array_equal(left.found_px, FOUND_PX)
    np.testing.assert_array_equal(left.found_covariance_px2, 0.01 * np.eye(2))
    assert (right.found_px, right.found_covariance_px2) == (None, None)
    assert (right.verdict, right.reason) == ("flat", "too little texture")
    assert record.found == {"hazcam_left": left}


def test_a_camera_that_was_not_looked_at_is_left_out(record: MatchedHandoff) -> None:
    assert set(record.landed) == set(REFINED)


def test_the_time_is_that_of_utc_to_the_millisecond(record: MatchedHandoff) -> None:
    assert record.time == "2026-02-28T23:30:00.250+00:00"
    assert datetime.fromisoformat(record.time).tzinfo == UTC
