"""Pointings are kept over a restart, bounded, and judged by the mast file in use."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.clock import SystemClock
from drivers.interfaces import COARSE_COUNT_RAD
from hil_tests.mastctl.service_fakes import fake_step
from hil_tests.mastctl.watch.histories import NOON_S, bumped, pointing, stored_rig
from hil_tests.waiting import until
from mastctl.answers import ResidualVerdict
from mastctl.control.operations import Operation
from mastctl.watch import evidence
from mastctl.watch.evidence import FILE, Measured, measured_by, measured_of, pointing_journal
from mastctl.watch.journal import JournalThread
from mastctl.watch.residuals import CalibrationHealth, mast_verdict, residual_verdict

STORED = stored_rig()


def history(count: int, turn_rad: float = 0.0) -> list[Measured]:
    rng = np.random.default_rng(1)
    true = bumped(STORED.rig, "pancam_left", (0.0, turn_rad, 0.0))
    return [pointing(STORED, true, rng, NOON_S + 60.0 * number) for number in range(count)]


def ended_pointing() -> Operation:
    at = {"pan_rad": 0.103, "tilt_rad": -0.198, "true_pan_rad": 0.1, "true_tilt_rad": -0.2}
    predicted = STORED.rig.camera_in_rover("pancam_left", 0.1, -0.2).project((3.0, 0.2, -1.0))[0]
    details: dict[str, Any] = {
        "rest": at,
        "triangulate": {"position_m": [3.0, 0.2, -1.0], "range_m": 3.1},
        "settle": at | {"count_rad": {"pan": 1e-4}},
        "measure": {
            "camera": "pancam_left",
            "pixel_px": [float(predicted[0]) - 0.5, float(predicted[1]) + 0.5],
            "sigma_px": [0.05, 0.06],
            "residual_px": [0.5, 1.5],
        },
    }
    steps = tuple(fake_step(name, **detail) for name, detail in details.items())
    request = {"pixel": {"camera": "navcam_right", "frame_id": "f", "x_px": 1.0, "y_px": 2.0}}
    return Operation("000001-ab", "done", request, 0.0, 0.0, 1.0, steps)


def test_a_pointing_keeps_what_measured_joints_do_not_explain() -> None:
    one = measured_by(ended_pointing(), STORED, NOON_S)
    assert one is not None
    assert (one["source"], one["partner"], one["camera"]) == ("navcam_right", "navcam_left", "pancam_left")
    assert one["residual_px"] == [0.5, 1.5]
    assert one["off_px"] == pytest.approx([-0.5, 0.5])
    assert one["count_rad"] == [1e-4, COARSE_COUNT_RAD]
    assert measured_of(json.loads(json.dumps(one))) == one


def test_what_no_other_camera_confirmed_is_marked() -> None:
    one = measured_by(replace(ended_pointing(), state="failed", error={"code": "eyes_disagree"}), STORED, 0.0)
    assert one is not None and not one["confirmed"]


@pytest.mark.parametrize(
    "change",
    [
        {"state": "failed", "error": {"code": "stopped"}},
        {"request": {"pan_rad": 0.1, "tilt_rad": 0.1}},
        {"steps": ()},
        {"steps": ended_pointing().steps[:2]},
    ],
)
def test_what_has_measured_nothing_is_not_kept(change: dict[str, object]) -> None:
    assert measured_by(replace(ended_pointing(), **change), STORED, NOON_S) is None  # type: ignore[arg-type]


def test_a_file_that_is_full_is_written_anew_with_what_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evidence, "MOST_BYTES", 3000)
    journal, known = pointing_journal(tmp_path), history(30)
    for number, one in enumerate(known):
        journal.append(one, known[max(0, number - 1) : number + 1])
        assert (tmp_path / FILE).stat().st_size <= 3000
    assert journal.read()[-2:] == known[-2:]


def test_a_drift_is_reported_after_a_restart_and_ends_with_another_mast_file(tmp_path: Path) -> None:
    for one in history(6, 2e-3):
        pointing_journal(tmp_path).append(one)
    thread = JournalThread(SystemClock())
    health = CalibrationHealth(tmp_path, STORED, thread, lambda: NOON_S + 600.0)
    until(lambda: health.verdict["verdict"] == "drifts", "it drifts")
    verdict = health.verdict
    assert "pancam_left" in verdict["sentence"] and "mrad" in verdict["sentence"]
    assert len(health.newest()) == verdict["pointings"] == 6
    health.use_mast(replace(STORED, digest="0" * 64))
    assert health.verdict["verdict"] == "few" and health.newest() == []
    health.use_mast(STORED)
    until(lambda: health.verdict["verdict"] == "drifts", "it drifts")
    thread.close()


def test_a_mast_file_that_does_not_say_how_sure_it_is_is_not_judged_by(tmp_path: Path) -> None:
    unsure = replace(STORED, rig=replace(STORED.rig, fit={}))
    thread = JournalThread(SystemClock())
    health = CalibrationHealth(tmp_path, unsure, thread, lambda: NOON_S)
    health.ended(unsure, ended_pointing())
    thread.close()
    assert health.verdict["verdict"] == "unknown"
    assert "fit.covariance" in health.verdict["sentence"]
    assert len(pointing_journal(tmp_path).read()) == 1


NOTHING_YET = residual_verdict("few", "few pointings")
DRIFTS = residual_verdict("drifts", "navcam_left looks 2 mrad beside", 9, "2026-05-02T00:00:00+00:00")
SLIPPED = {"level": "bad", "sentence": "pan slipped by 4 mrad", "since": "2026-05-01T00:00:00+00:00"}
OFFSET = {"sentence": "hazcam_left sees targets 2 px right"}


@pytest.mark.parametrize(
    ("residuals", "looks", "offsets", "verdict", "sentence", "since"),
    [
        (NOTHING_YET, None, [], "few", NOTHING_YET["sentence"], None),
        (NOTHING_YET, {**SLIPPED, "level": "unsure"}, [], "few", NOTHING_YET["sentence"], None),
        (DRIFTS, None, [], "drifts", DRIFTS["sentence"], DRIFTS["since"]),
        (NOTHING_YET, SLIPPED, [], "drifts", f"reference pictures: {SLIPPED['sentence']}", SLIPPED["since"]),
        (NOTHING_YET, None, [OFFSET], "drifts", f"hand-offs: {OFFSET['sentence']}", None),
        (
            DRIFTS, SLIPPED, [OFFSET], "drifts",
            f"{DRIFTS['sentence']}; reference pictures: {SLIPPED['sentence']}; "
            f"hand-offs: {OFFSET['sentence']}",
            SLIPPED["since"],
        ),
    ],
)  # fmt: skip
def test_the_mast_file_holds_as_long_as_nothing_speaks_against_it(
    residuals: ResidualVerdict, looks: Any, offsets: Any, verdict: str, sentence: str, since: str | None
) -> None:
    found = mast_verdict(residuals, looks, {"handoffs": 3, "offsets": offsets}, "")
    assert found == {
        "verdict": verdict, "sentence": sentence, "pointings": residuals["pointings"], "since": since
    }  # fmt: skip


def test_a_panoramas_seams_speak_too() -> None:
    found = mast_verdict(
        NOTHING_YET, None, {"handoffs": 0, "offsets": []}, "tilt stood +1 mrad beside its reading"
    )
    assert found["verdict"] == "drifts" and found["sentence"].startswith("panorama: tilt stood")
