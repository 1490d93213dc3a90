"""The hand-off experiment's own arithmetic and report; the runs themselves are a command."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest

from calib.handoff import Predicted
from calib.handoff_refined import RefinedPixel, Verdict
from mastctl.experiment.handoff_record import Handed, HandoffExperiment, HandoffRecord, summarise
from mastctl.experiment.handoff_report import table_rows, write_report

STEP = "navcam to hazcam"


def handed(
    geometric: tuple[float, float],
    refined: tuple[float, float],
    true: tuple[float, float] | None,
    verdict: Verdict = "accepted",
) -> Handed:
    nowhere = np.full(2, math.nan)
    found = np.array(refined) if verdict == "accepted" else nowhere
    return Handed(
        "hazcam_left",
        Predicted(np.array(geometric), np.eye(2), 4 * np.eye(2)),
        RefinedPixel(verdict, "" if verdict == "accepted" else "hidden <b>", found, np.eye(2), nowhere),
        true,
        np.zeros((480, 640), np.uint8),
    )


def record(index: int, *seen: Handed, error: str = "") -> HandoffRecord:
    image = None if error else np.zeros((768, 1024), np.uint8)
    clicked = (math.nan, math.nan) if error else (500.0, 300.0)
    frame = "" if error else "navcam_left-1"
    return HandoffRecord(STEP, index, 2.0, 2.1, frame, clicked, seen, error, 1.0, image)


RECORDS = (
    record(0, handed((103.0, 96.0), (100.5, 100.0), (100.0, 100.0))),
    record(1, handed((99.0, 100.0), (0.0, 0.0), (100.0, 100.0), "occluded")),
    record(2, error="no_stereo_point: <i>none</i>"),
)


def test_errors_are_against_the_truth_and_only_accepted_ones_are_refined() -> None:
    row = summarise(STEP, "ground", "hazcam_left", RECORDS)
    assert (row.targets, row.failed, row.accepted) == (3, 1, 1)
    assert row.geometric_rms_px == pytest.approx((math.sqrt(5.0), math.sqrt(8.0)))
    assert row.geometric_bias_px == pytest.approx((1.0, -2.0))
    assert row.geometric_worst_px == pytest.approx(5.0)
    assert row.refined_rms_px == pytest.approx(0.5)
    assert dict(row.verdicts) == {"accepted": 1, "occluded": 1}


def test_without_the_truth_the_refined_pixel_stands_in() -> None:
    one = handed((103.0, 96.0), (100.0, 100.0), None)
    assert one.geometric_error_px == (3.0, -4.0)
    assert one.refined_error_px is None
    assert handed((1.0, 1.0), (0.0, 0.0), None, "flat").geometric_error_px is None
    empty = summarise(STEP, "ground", "hazcam_right", RECORDS)
    assert empty.geometric_rms_px is None and empty.refined_rms_px is None


def test_the_report_holds_every_target_and_escapes_what_it_is_told(tmp_path: Path) -> None:
    summaries = (summarise(STEP, "ground", "hazcam_left", RECORDS),)
    experiment = HandoffExperiment({"hardware": "simulated"}, 1, 0.2, RECORDS, summaries, "now", 3.0)
    page = write_report(experiment, tmp_path / "new").read_text()
    assert "&lt;i&gt;none" in page and "hidden &lt;b&gt;" in page and "<i>none" not in page
    assert page.count("<figure>") == 4
    rows = list(csv.DictReader((tmp_path / "new/targets.csv").open()))
    assert [row["verdict"] for row in rows] == ["accepted", "occluded", ""]
    assert rows[0]["search_sigma_major_px"] == "2.0" and rows[1]["refined_x_px"] == ""
    document = json.loads((tmp_path / "new/record.json").read_text())
    assert document["handoffs"][0]["paper_worst_px"] == 4.0
    assert table_rows(summaries)[1][0][-1] == "4"
