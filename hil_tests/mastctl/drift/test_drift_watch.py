"""The watch over the mast file: what it keeps over a restart, bounded; its verdict; files that fail."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.files.mast_file import StoredRig
from drivers.clock import ManualClock
from drivers.interfaces import COARSE_COUNT_RAD
from hil_tests.mastctl.drift.histories import HAZCAMS, NOON_S, bumped, handed_over, pointing, stored_rig
from hil_tests.mastctl.service_fakes import Hang, fake_step
from hil_tests.waiting import until
from mastctl.answers import MeasuredPointing
from mastctl.control.operations import Operation
from mastctl.drift import journal
from mastctl.drift import watch as module
from mastctl.drift.evidence import pointing_sample, sample_of
from mastctl.drift.handoffs import read_log
from mastctl.drift.journal import NAME, Journal, JournalThread
from mastctl.drift.pictures import LOOKS, ReferencePicture, save_reference
from mastctl.drift.watch import FILE, DriftWatch, sample_journal

STORED = stored_rig()
OTHER = replace(STORED, digest="0" * 64)


class Watched:
    """A watch in a folder, with what panoramas say, and clocks that are turned by hand."""

    def __init__(self, folder: Path, mast: StoredRig = STORED, handoffs: Path | None = None) -> None:
        self.slip = ""
        self.clock, self.file_time = ManualClock(10.0), ManualClock()
        self.thread = JournalThread(self.clock, self.file_time)
        self.watch = DriftWatch(
            folder, handoffs, mast, lambda _: self.slip, self.thread, self.clock, lambda: NOON_S + 600.0
        )

    def drifts(self) -> None:
        until(lambda: self.watch.verdict()["verdict"] == "drifts", "it drifts")


@pytest.fixture
def watched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Watched]:
    """A watch that logs hand-offs into ``h.jsonl`` of its folder."""
    monkeypatch.setattr(journal, "POLL_S", 0.05)
    one = Watched(tmp_path, handoffs=tmp_path / "h.jsonl")
    yield one
    one.thread.close()


def history(count: int, turn_rad: float = 0.0) -> list[MeasuredPointing]:
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
    one = pointing_sample(ended_pointing(), STORED, NOON_S)
    assert one is not None
    assert (one["source"], one["partner"], one["camera"]) == ("navcam_right", "navcam_left", "pancam_left")
    assert one["residual_px"] == [0.5, 1.5]
    assert one["off_px"] == pytest.approx([-0.5, 0.5])
    assert one["count_rad"] == [1e-4, COARSE_COUNT_RAD]
    assert sample_of(json.loads(json.dumps(one))) == one


def test_what_no_other_camera_confirmed_is_marked() -> None:
    failed = replace(ended_pointing(), state="failed", error={"code": "eyes_disagree"})
    one = pointing_sample(failed, STORED, 0.0)
    assert one is not None and not one["confirmed"]


@pytest.mark.parametrize(
    "change",
    [
        {"state": "failed", "error": {"code": "stopped"}},
        {"request": {"pan_rad": 0.1, "tilt_rad": 0.1}},
        {"steps": ()},
        {"steps": ended_pointing().steps[:2]},
    ],
    ids=["stopped", "no pixel", "no step", "two steps"],
)
def test_what_has_measured_nothing_is_not_kept(change: dict[str, object]) -> None:
    assert pointing_sample(replace(ended_pointing(), **change), STORED, NOON_S) is None  # type: ignore[arg-type]


def test_a_file_that_is_full_is_written_anew_with_what_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MOST_BYTES", 3000)
    kept, known = sample_journal(tmp_path), history(30)
    for number, one in enumerate(known):
        kept.append(one, known[max(0, number - 1) : number + 1])
        assert (tmp_path / FILE).stat().st_size <= 3000
    assert kept.read()[-2:] == known[-2:]


def test_a_drift_is_reported_after_a_restart_and_ends_with_another_mast_file(tmp_path: Path) -> None:
    for one in history(6, 2e-3):
        sample_journal(tmp_path).append(one)
    watched = Watched(tmp_path)
    watched.drifts()
    report = watched.watch.report()
    assert report["sentence"].startswith("pancam_left ")
    assert "is turned by 1.98 ± 0.04 mrad" in report["sentence"] and "y +1.98" in report["sentence"]
    assert report["since"] == "2024-10-04T12:00:00+00:00"
    assert len(report["newest"]) == report["pointings"] == 6
    watched.watch.use_mast(OTHER)
    assert watched.watch.verdict()["verdict"] == "few" and watched.watch.report()["newest"] == []
    watched.watch.use_mast(STORED)
    watched.drifts()
    watched.thread.close()


def test_a_mast_file_that_does_not_say_how_sure_it_is_is_not_judged_by(tmp_path: Path) -> None:
    unsure = replace(STORED, rig=replace(STORED.rig, fit={}))
    watched = Watched(tmp_path, unsure)
    watched.watch.ended(unsure, ended_pointing())
    watched.thread.close()
    verdict = watched.watch.verdict()
    assert verdict["verdict"] == "unknown" and "fit.covariance" in verdict["sentence"]
    assert len(sample_journal(tmp_path).read()) == 1


def test_hand_offs_are_logged_counted_and_speak_against_the_mast_file(
    tmp_path: Path, watched: Watched, caplog: pytest.LogCaptureFixture
) -> None:
    rng, true = np.random.default_rng(4), STORED.rig
    for camera in HAZCAMS:
        true = bumped(true, camera, (0.0, 0.0, 4e-3))
    made = [handed_over(STORED, true, rng) for _ in range(20)]
    for one in made:
        watched.watch.handed_over(one)
    watched.watch.handed_over(replace(made[0], mast_digest=OTHER.digest))
    watched.drifts()
    until(lambda: watched.watch.verdict()["pointings"] == 40, "both cameras of each count")
    assert watched.watch.report()["newest"] == [], "they are no pointings"
    until(lambda: any("the calibration drifts: " in line for line in caplog.messages), "it is logged")
    watched.thread.close()
    (line,) = [line for line in caplog.messages if "the calibration drifts" in line]
    assert "hazcam" in line and "mrad" in line
    assert len(read_log(tmp_path / "h.jsonl").handoffs) == 21
    assert len(sample_journal(tmp_path).read()) == 40


def test_each_source_that_speaks_against_the_mast_file_is_in_the_verdict(
    tmp_path: Path, watched: Watched
) -> None:
    assert watched.watch.verdict()["verdict"] == "few"
    watched.slip = "tilt stood +1 mrad beside its reading"
    verdict = watched.watch.verdict()
    assert (verdict["verdict"], verdict["sentence"]) == ("drifts", f"panorama: {watched.slip}")
    folder = tmp_path / "sentinel"
    image = ReferencePicture("navcam_left", 0, 0.0, 0.0, STORED.digest, np.zeros((4, 4), np.float32))
    reference = save_reference(folder, "2026-05-01T00:00:00+00:00", [(0.0, 0.0)], [image])
    look = {"reference": reference.time, "views": 1, "changed": True, "sentence": "the images moved"}
    days = ("2026-05-02T00:00:00+00:00", "2026-05-03T00:00:00+00:00")
    (folder / LOOKS).write_text("".join(json.dumps(look | {"time": day}) + "\n" for day in days))
    until(lambda: watched.watch.pictures["level"] == "bad", "the looks are read")
    verdict = watched.watch.verdict()
    assert verdict["sentence"].startswith("reference images: the images moved, since ")
    assert verdict["sentence"].endswith(f"; panorama: {watched.slip}")
    assert verdict["since"] == days[0]
    watched.watch.use_mast(OTHER)
    assert watched.watch.pictures["level"] == "unsure", "they are of another mast file"


def test_a_log_that_cannot_be_written_is_a_fault_and_nothing_else(tmp_path: Path) -> None:
    watched = Watched(tmp_path, handoffs=Path("/dev/full"))
    watched.watch.handed_over(handed_over(STORED, STORED.rig, np.random.default_rng(1)))
    until(lambda: watched.watch.verdict()["pointings"] or watched.watch.faults(), "the fault")
    until(watched.watch.faults, "the fault")
    (fault,) = watched.watch.faults()
    assert (fault.device, fault.code) == (NAME, "unwritable")
    assert fault.message.startswith("/dev/full") and "count until the daemon ends" in fault.message
    watched.thread.close()
    assert len(sample_journal(tmp_path).read()) == 2


def test_a_file_that_hangs_delays_no_caller(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hang = Hang()
    monkeypatch.setattr(Journal, "append", lambda self, *_: hang())
    monkeypatch.setattr(journal, "CLOSE_S", 0.05)
    before = set(threading.enumerate())
    watched = Watched(tmp_path)
    watched.watch.ended(STORED, ended_pointing())
    assert hang.entered.wait(60.0)
    assert watched.thread.faults() == ()
    watched.clock.advance(60.0)  # a simulated rover's minute may be a moment of the file's
    assert watched.thread.faults() == ()
    watched.file_time.advance(60.0)
    (fault,) = watched.thread.faults()
    assert (fault.code, fault.since_s) == ("slow", 10.0)
    assert "does not answer" in fault.message
    watched.thread.close()
    hang.let_go()
    until(lambda: not any(t.name == NAME for t in {*threading.enumerate()} - before), "its thread ends")
