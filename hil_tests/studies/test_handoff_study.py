"""The hand-off experiment's own arithmetic and report; the runs themselves are a command."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from calib.files.mast_file import load_rig
from calib.geometry.handoff import Joints, PredictedPixel
from calib.geometry.rigid import Rigid
from calib.matching.handed_over import Landed, MatchedHandoff
from calib.matching.handoff import RefinedPixel, RefinedVerdict
from drivers.sim import rocks
from drivers.sim.rover import SimulatedRover
from drivers.sim.scene import Scene, tiny_scene
from mastctl.cli.output import WrongUse
from mastctl.client import Client, ClientError
from mastctl.watch.handoffs import read_log
from tools.studies import handoff as study
from tools.studies.handoff_record import (
    Handed,
    HandoffExperiment,
    HandoffRecord,
    summarise_handoffs,
)
from tools.studies.handoff_report import handoff_table, handoff_targets, view_picture, write_handoff_report
from tools.studies.handoff_run import KnownPoint, run_handoff_experiment

STEP = "navcam to hazcam"
FRAME = "hazcam_left-000001-00000000-0000"


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
    row = summarise_handoffs(STEP, "ground", "hazcam_left", RECORDS)
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
    empty = summarise_handoffs(STEP, "ground", "hazcam_right", RECORDS)
    assert empty.geometric_rms_px is None and empty.refined_rms_px is None


def test_the_report_holds_every_target_and_escapes_what_it_is_told(tmp_path: Path) -> None:
    summaries = (summarise_handoffs(STEP, "ground", "hazcam_left", RECORDS),)
    experiment = HandoffExperiment({"hardware": "simulated"}, 1, 0.2, RECORDS, summaries, "now", 3.0)
    page = write_handoff_report(experiment, tmp_path / "new").read_text()
    assert "&lt;i&gt;none" in page and "hidden &lt;b&gt;" in page and "<i>none" not in page
    assert page.count("<figure ") == 5  # the plot, and pictures of two targets
    assert "errors of each target" in page
    rows = list(csv.DictReader((tmp_path / "new/targets.csv").open()))
    assert [row["verdict"] for row in rows] == ["accepted", "occluded", ""]
    assert rows[0]["search_sigma_major_px"] == "2.0" and rows[1]["refined_x_px"] == ""
    document = json.loads((tmp_path / "new/record.json").read_text())
    assert document["handoffs"][0]["paper_worst_px"] == 4.0
    assert handoff_table(summaries)[1][0][-1] == "4"


def test_kinds_of_targets_have_rows_of_their_own() -> None:
    corner = replace(RECORDS[0], index=3, kind="corner")
    records = (*RECORDS, corner)
    assert summarise_handoffs(STEP, "ground", "hazcam_left", records).targets == 3
    assert summarise_handoffs(STEP, "corner", "hazcam_left", records).targets == 1
    headings, rows = handoff_targets(records)
    assert all(len(row) == len(headings) for row in rows)
    assert rows[3][:3] == [STEP, "3", "corner"] and rows[3][4:6] == ["3.00, -4.00", "0.50, 0.00"]
    assert rows[1][5] == "occluded"


def test_a_views_picture_marks_every_target_where_it_is() -> None:
    one = handed((300.0, 200.0), (300.0, 200.0), (300.0, 200.0))
    other = replace(one, geometric=replace(one.geometric, pixel_px=np.array([340.0, 230.0])), true_px=None)
    picture = view_picture([(0, one), (1, other)])
    middle = picture.shape[0] // 2
    scale = middle // (20 + 30)
    for x, y in ((-20, -15), (20, 15)):
        piece = picture[middle + scale * y - 2 :, middle + scale * x - 2 :][:5, :5]
        assert piece.any(), "a cross is drawn on black"


def test_bricks_points_are_seen_only_where_nothing_hides_them(repository: Path) -> None:
    """A brick ahead of the Hazcam shows the front of its top and hides the ground and its own far side."""
    scene = tiny_scene()
    brick = rocks.make_brick(1.7, 0.0, 0.3, lambda x, y: 0.0)
    world = scene.world._replace(rocks=rocks.meshes([brick]))
    camera = load_rig(repository / "configs/sim/rocky8.yaml").rig.cameras["hazcam_left"].model
    truth = SimpleNamespace(camera_in_rover=camera, site_from_rover=Rigid.identity())
    rover: Any = SimpleNamespace(
        scene=Scene(scene.settings, world, (brick,)),
        site_from_rover=Rigid.identity(),
        frame_truth=lambda camera, sequence: truth,
    )
    known = study.BrickPoints(cast(SimulatedRover, rover))
    points = known.points()
    assert [point.kind for point in points] == ["corner"] * 4 + ["face"] * 5
    seen = {tuple(point.position_m): known.seen_px(FRAME, point.position_m) for point in points}
    for corner in brick.corners_m[:4]:
        pixel = seen[tuple(corner)]
        assert pixel is not None, "no upper corner is hidden from above"
        np.testing.assert_allclose(pixel, camera.project(corner)[0])
    middle = brick.corners_m.mean(axis=0)
    for face in brick.faces_m:
        turned_to_camera = (face - middle) @ (camera.C - face) > 0
        assert (seen[tuple(face)] is not None) == turned_to_camera
    assert known.seen_px(FRAME, np.array([2.1, 0.0, -0.001])) is None, "behind the brick"
    assert known.seen_px(FRAME, np.array([-3.0, 0.0, 0.0])) is None, "behind the camera"


@pytest.mark.parametrize("words", [["--bricks", "3"], ["--simulated", "--bricks", "25"]])
def test_bricks_are_the_simulations_and_few(words: list[str]) -> None:
    with pytest.raises(WrongUse, match="1 to 24 are possible, with --simulated"):
        study.main(words)


class StuckDaemon:
    """What of a client the experiment uses; the first view takes too long, the others are refused."""

    url = "http://127.0.0.1:1"

    def __init__(self, mast: bytes) -> None:
        self.mast, self.calls = mast, list[str]()

    def simulation_time(self) -> dict[str, Any]:
        raise ClientError("not_simulated", "clocks are for a simulated rover only")

    def status(self) -> dict[str, Any]:
        cameras = [f"{pair}_{eye}" for pair in ("pancam", "navcam") for eye in ("left", "right")]
        limits = {"pan_rad": [-2.0, 2.0], "tilt_rad": [-1.0, 1.0]}
        return {"hardware": "simulated", "cameras": dict.fromkeys(cameras), "limits": limits, "now_s": 1.0}

    def mast_file(self) -> bytes:
        return self.mast

    def point(self, **request: Any) -> str:
        self.calls.append("point")
        if len(self.calls) > 1:
            raise ClientError("busy", "operation 7 is running; wait for it or stop it")
        return "000001"

    def wait(self, operation: str, timeout_s: float) -> dict[str, Any]:
        raise ClientError("timeout", f"operation {operation} has not ended after {timeout_s:g} s")

    def stop(self) -> dict[str, Any]:
        self.calls.append("stop")
        return {"stopped": True, "operation": None}


class Stakes:
    """Three points some 6 m away, one a view."""

    def points(self) -> list[KnownPoint]:
        return [KnownPoint("corner", group, np.array([6.0, group - 1.0, 0.0])) for group in range(3)]

    def seen_px(self, frame_id: str, position_m: np.ndarray) -> tuple[float, float] | None:
        raise AssertionError("no view is taken")


@pytest.mark.parametrize(("targets", "calls"), [(2, ["point", "stop", "point"]), (1, ["point", "stop"])])
def test_a_view_that_fails_is_a_failed_target_and_no_more_are_turned_to_than_asked(
    repository: Path, targets: int, calls: list[str]
) -> None:
    daemon = StuckDaemon((repository / "configs/sim/rocky8.yaml").read_bytes())
    run = run_handoff_experiment(cast(Client, daemon), targets=targets, points=Stakes())
    assert daemon.calls == calls
    reasons = [
        "timeout: operation 000001 has not ended after 60 s",
        "busy: operation 7 is running; wait for it or stop it",
    ]
    assert [record.error for record in run.records] == reasons[:targets]
    assert {(row.kind, row.targets, row.failed) for row in run.summaries} == {("corner", targets, targets)}


def test_the_record_of_hand_offs_and_a_constant_offset_are_told(tmp_path: Path) -> None:
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
    experiment = HandoffExperiment({"hardware": "simulated"}, 1, 0.2, tuple(records), (), "now", 3.0)
    page = write_handoff_report(experiment, tmp_path).read_text()
    write_handoff_report(experiment, tmp_path)  # a second run replaces the first one's record
    assert len(read_log(tmp_path / "handoffs.jsonl").handoffs) == 10
    told = "2.00 +- 0.13 px higher of where navcam puts them"
    assert told in page and "calibrate --refine" in page
    (bias,) = experiment.as_json()["bias"]
    assert bias["camera"] == "hazcam_left" and told in bias["sentence"] and bias["sigmas"] > 10
    assert json.loads((tmp_path / "record.json").read_text())["bias"] == [bias]


def test_an_experiment_without_any_target_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    nothing = HandoffExperiment({"hardware": "simulated"}, 1, 0.2, (), (), "now", 3.0)
    monkeypatch.setattr(study, "_on_daemon", lambda args, client: nothing)
    out = tmp_path / "report"
    assert study.main(["--url", "http://127.0.0.1:9", "--out", str(out)]) == 1
    told = capsys.readouterr().out.splitlines()
    assert told == ["no target was found to hand over", f"report: {out / 'report.html'}"]


def test_another_mast_file_is_for_the_simulated_rover_only() -> None:
    with pytest.raises(WrongUse, match="--simulated"):
        study.main(["--mast-file", "m.yaml"])


@pytest.mark.parametrize(
    "words",
    [["--executor", "dask:tcp://127.0.0.1:1"], ["--workers", "2"], ["--list-tasks"], ["--results", "kept"]],
)
def test_a_running_daemon_takes_no_executor(words: list[str]) -> None:
    with pytest.raises(WrongUse, match=f"{words[0]} belongs to --simulated"):
        study.main(["--url", "http://127.0.0.1:9", *words])


def test_simulated_rovers_are_no_running_daemon() -> None:
    with pytest.raises(WrongUse, match="names a running daemon"):
        study.main(["--simulated", "--url", "http://127.0.0.1:9"])


def test_another_mast_file_is_another_task_by_its_content(
    tmp_path: Path, repository: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    packaged = (repository / "configs/masts/rocky8_simulated.yaml").read_text()
    names = []
    for name, text in (("a.yaml", packaged), ("b.yaml", packaged), ("c.yaml", f"# another\n{packaged}")):
        (tmp_path / name).write_text(text)
        words = [
            "--simulated",
            "--targets",
            "1",
            "--mast-file",
            str(tmp_path / name),
            "--list-tasks",
            "--json",
        ]
        with pytest.raises(SystemExit, match=r"^0$"):
            study.main(words)
        names.append([row["id"] for row in json.loads(capsys.readouterr().out)["tasks"]])
    assert names[0] == names[1] != names[2]
    assert len(names[0]) == 2, "from Pancam and from Navcam"
