"""False alarms and alarms, over simulated days whose truth the judge never sees."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from hil_tests.mastctl.drift.histories import (
    DAY_S,
    HAZCAMS,
    NOON_S,
    bumped,
    handed_over,
    honest,
    pointing,
    stored_rig,
)
from mastctl.drift.evidence import LOG_THRESHOLD, Judge, Windows, handoff_samples, rows_of, verdict_of

CAMERAS = ("pancam_left", "navcam_left", "navcam_right")
BUMP_RAD = 2e-3


def test_evidence_is_a_fair_bet_while_the_mast_file_holds() -> None:
    """Its mean over honest histories is 1: that is what bounds the false alarms."""
    rng = np.random.default_rng(21)
    judge = Judge(np.eye(2), {"a": (0,)})
    ratios = []
    for _ in range(20_000):
        rates, turned = rng.normal(0.0, 1.0, (2, 2)), rng.normal(0.0, 200.0, (2, 3))
        off = rates @ rng.normal(0.0, 1.0, 2) + rng.normal(0.0, 1.0, 2)
        rows = rows_of(np.eye(2), rates, turned, off)
        ratios.append(math.exp(judge.weigh(rows.T @ rows, 1, 0.0).log_evidence))
    assert np.mean(ratios) == pytest.approx(1.0, abs=5 * float(np.std(ratios)) / math.sqrt(len(ratios)))


def test_an_honest_rig_raises_no_alarm_and_stays_within_expectation() -> None:
    stored = stored_rig()
    for seed in range(25):
        rng = np.random.default_rng(seed)
        true, windows = honest(stored.rig, rng), Windows(stored)
        for number in range(9):
            windows.add(pointing(stored, true, rng, NOON_S + 60.0 * number, CAMERAS[number % 3]))
        evidence = windows.evidence()
        assert evidence is not None
        assert evidence.log_evidence < LOG_THRESHOLD, f"seed {seed}"
        assert evidence.times < 1.2, f"seed {seed}"


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("axis", [1, 2])
def test_a_camera_bumped_by_2_mrad_is_named_within_six_pointings(camera: str, axis: int) -> None:
    stored = stored_rig()
    rng = np.random.default_rng(7)
    turn = [0.0, 0.0, 0.0]
    turn[axis] = BUMP_RAD
    true = bumped(honest(stored.rig, rng), camera, (turn[0], turn[1], turn[2]))
    windows = Windows(stored)
    for number in range(6):
        windows.add(pointing(stored, true, rng, NOON_S + 60.0 * number, CAMERAS[number % 3]))
    verdict = verdict_of(windows.evidence(), 6)
    assert verdict["verdict"] == "drifts"
    assert camera in verdict["sentence"]
    (about,) = re.findall(rf"about .*{'xyz'[axis]} \+(\d\.\d+)", verdict["sentence"])
    assert float(about) == pytest.approx(1e3 * BUMP_RAD, abs=0.3)
    assert verdict["cameras"][camera]["turn_rad"][axis] == pytest.approx(BUMP_RAD, abs=1e-3)


def test_a_bump_is_dated_after_days_without_one() -> None:
    stored = stored_rig()
    rng = np.random.default_rng(3)
    before = honest(stored.rig, rng)
    after = bumped(before, "pancam_left", (0.0, BUMP_RAD, 0.0))
    windows = Windows(stored)
    for day in range(-4, 1):
        for number in range(6):
            true = before if day < 0 else after
            windows.add(
                pointing(stored, true, rng, NOON_S + day * DAY_S + 60.0 * number, CAMERAS[number % 3])
            )
        loudest = windows.evidence()
        assert loudest is not None
        assert (loudest.log_evidence >= LOG_THRESHOLD) == (day == 0)
    verdict = verdict_of(windows.evidence(), 30)
    assert verdict["since"] is not None and verdict["since"].startswith("2024-10-04T12:0")
    windows.forget(NOON_S + 8 * DAY_S)
    assert windows.evidence() is None


def test_one_false_match_is_no_drift() -> None:
    stored = stored_rig()
    rng = np.random.default_rng(5)
    true, windows = honest(stored.rig, rng), Windows(stored)
    for number in range(8):
        one = pointing(stored, true, rng, NOON_S + number)
        if number == 4:
            one = {**one, "off_px": [30.0, -20.0]}
        windows.add(one)
    evidence = windows.evidence()
    assert evidence is not None and evidence.log_evidence < LOG_THRESHOLD


def test_unconfirmed_false_matches_are_no_drift_and_a_bump_is_one() -> None:
    """The bump also where no pointing at all is confirmed any more."""
    stored = stored_rig()
    for what, turn_rad, expected in (
        ("false", 0.0, "good"),
        ("bump", BUMP_RAD, "drifts"),
        ("all fail", BUMP_RAD, "drifts"),
    ):
        rng = np.random.default_rng(6)
        true = bumped(honest(stored.rig, rng), "pancam_left", (0.0, turn_rad, 0.0))
        windows = Windows(stored)
        for number in range(12):
            one = pointing(stored, true, rng, NOON_S + number)
            if number % 2 or what == "all fail":
                off = rng.uniform(-48.0, 48.0, 2).tolist() if what == "false" else one["off_px"]
                one = {**one, "confirmed": False, "off_px": off}
            windows.add(one)
        assert verdict_of(windows.evidence(), 12)["verdict"] == expected, what


def test_a_turned_body_pair_is_named_by_hand_offs_with_its_axis_and_size() -> None:
    stored, rng = stored_rig(), np.random.default_rng(4)
    true, windows = honest(stored.rig, rng), Windows(stored)
    for camera in HAZCAMS:
        true = bumped(true, camera, (0.0, 0.0, 2 * BUMP_RAD))
    for number in range(20):
        for one in handoff_samples(handed_over(stored, true, rng), stored, NOON_S + 60.0 * number):
            assert windows.add(one) is not None
    verdict = verdict_of(windows.evidence(), len(windows.judged))
    assert verdict["verdict"] == "drifts" and verdict["pointings"] == 40
    assert verdict["sentence"].startswith("hazcam or navcam is turned by 3."), "relative to each other"
    assert verdict["cameras"]["hazcam"]["turn_rad"] == pytest.approx([0.0, 0.0, 2 * BUMP_RAD], abs=1e-3)


def test_hand_offs_of_an_honest_rig_raise_no_alarm() -> None:
    stored = stored_rig()
    for seed in range(10):
        rng = np.random.default_rng(seed)
        true, windows = honest(stored.rig, rng), Windows(stored)
        for number in range(10):
            for one in handoff_samples(handed_over(stored, true, rng), stored, NOON_S + 60.0 * number):
                windows.add(one)
        evidence = windows.evidence()
        assert evidence is not None and evidence.log_evidence < LOG_THRESHOLD, f"seed {seed}"
        assert evidence.times < 1.2, f"seed {seed}"
