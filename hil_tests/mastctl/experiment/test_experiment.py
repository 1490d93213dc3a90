"""The pointing experiment apart from the daemon: choosing targets, summing up, the report."""

from __future__ import annotations

import csv
import json
import math
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import mastctl
from calib.files.mast_file import load_rig
from mastctl.cli.experiment import become_study
from mastctl.cli.output import WrongUse
from mastctl.client import Client, ClientError
from mastctl.experiment.pointing import (
    DistanceSummary,
    Landing,
    PointingExperiment,
    TargetRecord,
    rms,
    run_pointing_experiment,
)
from mastctl.experiment.pointing_report import COLUMNS, write_pointing_report
from mastctl.experiment.targets import on_level_ground, pointed, texture_mask


def landed(index: int, x_px: float, y_px: float, error: str = "") -> TargetRecord:
    """A target at 6 m that landed once at (x, y) and once on the spot, with pictures."""
    picture = np.full((768, 1024), 100, dtype=np.uint8)
    landings = (
        Landing((x_px, y_px), (0.02, 0.03), "navcam_left-000002-x-y", (x_px + 0.1, y_px)),
        Landing((0.0, 0.0), (0.02, 0.03), "navcam_left-000003-x-y", (0.0, 0.1)),
    )
    return TargetRecord(
        6.0, index, "navcam_left", "navcam_left-000001-x-y", (300.0, 400.0), 6.1, 0.1, -0.2, landings,
        error, 4.0, {"id": "1"}, picture, (picture, picture),
    )  # fmt: skip


def lost(index: int, error: str) -> TargetRecord:
    """A target at 6 m that never was found."""
    return TargetRecord(6.0, index, "navcam_left", error=error, seconds=9.0)


def experiment(*records: TargetRecord) -> PointingExperiment:
    """An experiment at 6 m and a target at 4 m that was not found."""
    status = {"hardware": "simulated", "mast": {"file": "m.yaml", "digest": "ab" * 32}, "cameras": {}}
    far = TargetRecord(4.0, 0, "navcam_left", error="dark")
    return PointingExperiment(
        status, 1, "navcam_left", (511.5, 383.5), (*records, far), "2026-01-01T00:00:00Z", 12.0, ("a note",)
    )


def test_failed_targets_are_counted_and_not_averaged() -> None:
    row = DistanceSummary.of(6.0, [landed(0, 3.0, 0.0), landed(1, -1.0, 2.0), lost(2, "flat")])
    assert (row.targets, row.failed, row.seconds) == (3, 1, 17.0)
    assert row.first_rms_px == pytest.approx((math.sqrt(5.0), math.sqrt(2.0)))
    assert row.true_second_rms_px == pytest.approx((0.0, 0.1))
    assert rms([]) is None


def test_document_has_the_keys_of_the_contract_and_every_failure() -> None:
    document = json.loads(json.dumps(experiment(landed(0, 0.1, 0.2), lost(1, "not_found: gone")).as_json()))
    first = document["distances"][0]
    assert {"distance_m", "targets", "first_rms_px", "second_rms_px", "seconds"} <= set(first)
    assert first["paper_first_rms_px"] == [0.743, 1.243]
    assert "paper_first_rms_px" not in document["distances"][1]
    assert document["failures"][0] == {"distance_m": 6.0, "target": 1, "error": "not_found: gone"}


def test_report_holds_every_target_and_what_devices_say_is_escaped(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "report"
    page = write_pointing_report(experiment(landed(0, 0.25, -0.5), lost(1, "<b>no & reply</b>")), folder)
    words = page.read_text(encoding="utf-8")
    assert "&lt;b&gt;no &amp; reply&lt;/b&gt;" in words
    assert "<b>no" not in words
    assert "+0.25, -0.50 px from the cross-hair" in words
    assert "http" not in words  # self-contained
    with (folder / "targets.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    assert [row["error"] for row in rows] == ["", "<b>no & reply</b>", "dark"]
    assert (rows[0]["first_x_px"], rows[0]["second_true_y_px"]) == ("0.25", "0.1")
    assert (rows[1]["first_x_px"], rows[1]["range_m"]) == ("", "")
    assert len(json.loads((folder / "record.json").read_text())["targets"]) == 3


def test_only_texture_in_both_directions_counts() -> None:
    rng = np.random.default_rng(3)
    image = np.full((400, 600), 120.0)
    image[:, 200:400] += rng.normal(0, 25, (400, 200))  # texture
    image[:, 400:] += 60.0 * (np.arange(200) // 20 % 2)  # stripes: one direction only
    mask = texture_mask(np.clip(image, 0, 255).astype(np.uint8))
    assert mask[100:300, 240:360].all()
    assert not mask[:, :170].any()
    assert not mask[100:300, 430:].any()
    assert not mask[:64].any()


def test_level_ground_at_the_distance_is_where_geometry_puts_it(repository: Path) -> None:
    rig = load_rig(repository / "configs" / "masts" / "rocky8_simulated.yaml").rig
    camera = rig.camera_in_rover("navcam_left", 0.3, -0.3)
    mask = on_level_ground(camera, 5.0)
    direction = np.array([math.cos(0.4), math.sin(0.4), 0.0])
    for along_m, seen in ((4.79, True), (3.0, False), (8.0, False)):
        pixel, valid = camera.project(np.array([camera.C[0], camera.C[1], 0.0]) + along_m * direction)
        assert valid
        assert mask[round(pixel[1]), round(pixel[0])] == seen, along_m


class SlowDaemon:
    """What of a client an experiment uses; the first operations end only when they are stopped."""

    def __init__(self, slow: int) -> None:
        self.slow, self.running, self.calls = slow, "", list[str]()

    def point(self, **request: Any) -> str:
        if self.running:
            raise ClientError("busy", f"operation {self.running} is running; wait for it or stop it")
        self.running = f"{len(self.calls):06d}"
        self.calls.append("point")
        return self.running

    def wait(self, operation: str, timeout_s: float) -> dict[str, Any]:
        if self.slow:
            raise ClientError("timeout", f"operation {operation} has not ended after {timeout_s:g} s")
        self.running = ""
        return {"state": "done"}

    def stop_operation(self, operation: str) -> dict[str, Any]:
        assert operation == self.running
        self.calls.append("stop")
        self.slow -= 1
        return {"state": "stopped"}


def test_an_operation_that_takes_too_long_is_stopped_for_the_next() -> None:
    daemon = SlowDaemon(1)
    with pytest.raises(ClientError, match=r"has not ended after 60 s"):
        pointed(cast(Client, daemon), pan_rad=0.1, tilt_rad=0.0)
    assert pointed(cast(Client, daemon), pan_rad=0.2, tilt_rad=0.0) == {"state": "done"}
    assert daemon.calls == ["point", "stop", "point"]


FAULT = {
    "device": "pan_tilt", "code": "no_reply", "message": "the head does not answer", "until": "it answers",
    "for_s": 1.0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("code", "faults", "note"),
    [
        ("stopped", [], "ended before target 0 at 10 m: refused"),
        ("estopped", [], "ended before target 0 at 10 m: refused"),
        ("leased", [], "ended before target 0 at 10 m: refused"),
        (
            "no_reply",
            [{**FAULT, "device": "hazcam_left"}, FAULT],
            "ended after target 0 at 10 m: pan_tilt has a fault until it answers: the head does not answer",
        ),
    ],
    ids=["stop", "emergency stop", "lease", "fault"],
)
def test_after_a_stop_or_a_fault_no_target_moves_the_head(
    code: str, faults: list[Any], note: str, repository: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moves: list[object] = []

    def refuse(client: Client, **request: Any) -> dict[str, Any]:
        moves.append(request)
        raise ClientError(code, "refused")

    monkeypatch.setattr("mastctl.experiment.targets.pointed", refuse)
    mast = (repository / "configs/masts/rocky8_simulated.yaml").read_bytes()
    limits = {"pan_rad": [-2.6, 2.6], "tilt_rad": [-1.2, 0.5]}
    cameras = dict.fromkeys(("navcam_left", "navcam_right", "hazcam_left"))
    status = {"now_s": 1.0, "limits": limits, "cameras": cameras, "faults": faults}
    client = SimpleNamespace(mast_file=lambda: mast, status=lambda: status)
    ran = run_pointing_experiment(cast(Client, client), targets=3)
    assert len(moves) == 1 and ran.notes == (note,)


def test_a_study_of_the_paper_runs_from_a_checkout(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mastctl", "experiment", "handoff", "--json", "--seed", "x"]
    refused = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (refused.returncode, json.loads(refused.stdout)["error"]["code"]) == (2, "wrong_use")


def test_without_a_checkout_its_experiments_say_how_to_get_one(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(mastctl, "__file__", str(tmp_path / "mastctl" / "__init__.py"))
    with pytest.raises(WrongUse, match=r"not in .*; in a clone of it, run tools/setup and then '\.venv/bin/"):
        become_study("handoff", ())
