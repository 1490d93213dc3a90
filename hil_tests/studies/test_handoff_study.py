"""The hand-off experiment's own arithmetic and report; the runs themselves are a command."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.geometry.handoff import Joints, PredictedPixel
from calib.matching.handoff import Landed, MatchedHandoff, RefinedPixel, RefinedVerdict
from mastctl.drift.handoffs import read_log
from tools.studies import handoff as study
from tools.studies.handoff import handoff_rows, write_handoffs
from tools.studies.handoff_run import Handed, HandoffRecord

STEP = "navcam to hazcam"


def handed(
    geometric: tuple[float, float],
    refined: tuple[float, float],
    true: tuple[float, float] | None,
    verdict: RefinedVerdict = "accepted",
) -> Handed:
    nowhere = np.full(2, math.nan)
    found = np.array(refined) if verdict == "accepted" else nowhere
    return Handed(
        "hazcam_left",
        PredictedPixel(np.array(geometric), np.eye(2), 4 * np.eye(2)),
        RefinedPixel(verdict, "" if verdict == "accepted" else "hidden", found, np.eye(2), nowhere),
        true,
    )


def record(index: int, *seen: Handed, error: str = "") -> HandoffRecord:
    if error:
        return HandoffRecord(STEP, index, error=error)
    return HandoffRecord(STEP, index, seen)


RECORDS = (
    record(0, handed((103.0, 96.0), (100.5, 100.0), (100.0, 100.0))),
    record(1, handed((99.0, 100.0), (0.0, 0.0), (100.0, 100.0), "occluded")),
    record(2, error="no_stereo_point: none"),
)


def test_errors_are_against_the_truth_and_only_accepted_ones_are_refined() -> None:
    (row,) = handoff_rows(RECORDS)
    assert (row["targets"], row["failed"], row["accepted"]) == (3, 1, 1)
    assert row["geometric_rms_px"] == pytest.approx((math.sqrt(5.0), math.sqrt(8.0)))
    assert row["geometric_bias_px"] == pytest.approx((1.0, -2.0))
    assert row["geometric_worst_px"] == pytest.approx(5.0)
    assert row["refined_rms_px"] == pytest.approx(0.5)
    assert row["verdicts"] == {"accepted": 1, "occluded": 1}
    assert row["paper_worst_px"] == 4.0


def test_without_the_truth_the_refined_pixel_stands_in() -> None:
    one = handed((103.0, 96.0), (100.0, 100.0), None)
    assert one.geometric_error_px == (3.0, -4.0)
    assert one.refined_error_px is None
    assert handed((1.0, 1.0), (0.0, 0.0), None, "flat").geometric_error_px is None
    (failed,) = handoff_rows(RECORDS[2:])
    assert failed["geometric_rms_px"] is None and failed["refined_rms_px"] is None


def test_the_record_of_hand_offs_and_a_constant_offset(tmp_path: Path) -> None:
    records = []
    for index in range(10):
        there = np.array([100.0 + 20 * index, 200.0])
        found = there + np.array([0.5 + 0.02 * index, -2.0])
        landed = {
            "hazcam_left": Landed(there, 0.01 * np.eye(2), "accepted", "", found, 0.01 * np.eye(2)),
            "hazcam_right": Landed(there, 0.01 * np.eye(2), "flat", "no texture"),
        }
        at = Joints(0.0, -0.5)
        matched = MatchedHandoff(
            "2026-01-01T00:00:00Z",
            "d",
            ("navcam_left", "navcam_right"),
            at,
            there + np.eye(2),
            0.2,
            at,
            landed,
        )
        records.append(replace(record(index), matched=matched))
    write_handoffs(tmp_path, records)
    write_handoffs(tmp_path, records)  # a second run replaces the first one's record
    assert len(read_log(tmp_path / "handoffs.jsonl").handoffs) == 10
    offset, remedy = study.bias_sentences(records)
    assert "2.00 +- 0.13 px higher of where navcam puts them" in offset
    assert "calibrate --refine" in remedy
