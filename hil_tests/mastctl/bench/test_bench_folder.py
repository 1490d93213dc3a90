"""``mastctl calibrate bench FOLDER``: a bench's folder fitted again, and what is reported of it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.adjust.result import BenchCalibration
from calib.calibrate.bench import fit_bench
from calib.calibrate.starts.bench import BoardMoved
from calib.files.mast_file import load_rig, save_rig
from calib.geometry.covariance import stored_covariance
from calib.geometry.rig import Mast
from calib.survey.reader import read_survey
from calib.survey.records import Survey
from calib.survey.writer import write_survey
from hil_tests.support.sim_survey.bench import (
    NAVCAMS,
    BenchCamera,
    BenchPlan,
    Mishap,
    Placement,
    simulate_bench,
)
from mastctl.bench import survey as bench_survey
from mastctl.bench.known import corner_noise
from mastctl.bench.survey import FORMER, fit_in_frame
from mastctl.calibration.verdict import judge
from mastctl.cli.main import main

HAZCAM = BenchCamera(
    "rover", (640, 480), (420.0, 421.0), (318.0, 242.0), (-0.05, 0.01), (0.1, 0.05, 0.9), (0.02, 0.25, 0.03)
)
LOW = (
    Placement(1.1, 0.1, -0.3, (0.35, 0.1, 0.1)),
    Placement(1.5, 0.25, -0.45, (-0.3, 0.4, 0.0)),
    Placement(1.7, -0.25, -0.5, (0.2, -0.4, 0.05)),
)


SERVO = BenchPlan(attitudes=9, checks=3, backlash_rad=0.004, count_rad=2 * np.pi / 4096)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bench whose mast stands at the rover's origin, with a body camera that sees every placement."""
    plan = BenchPlan(cameras={**NAVCAMS, "hazcam": HAZCAM}, placements=LOW, attitudes=9, checks=2)
    return write_survey(simulate_bench(1, plan), tmp_path_factory.mktemp("bench") / "b").folder


TRUE = BenchPlan(cameras={**NAVCAMS, "hazcam": HAZCAM}).rig


@pytest.fixture(scope="module")
def servo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A servo's bench."""
    return write_survey(simulate_bench(1, SERVO), tmp_path_factory.mktemp("bench") / "b").folder


def run(capsys: pytest.CaptureFixture[str], *words: str | Path) -> tuple[int, Any]:
    """Exit code and JSON of the command."""
    capsys.readouterr()
    code = main([str(word) for word in ("calibrate", "bench", *words, "--json")])
    return code, json.loads(capsys.readouterr().out)


def test_a_body_camera_that_nothing_ties_is_named_and_stays_where_it_was(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    far = (
        *LOW[:1],
        Placement(1.7, -0.9, -0.1, (-0.3, 0.5, 0.0)),
        Placement(2.6, 0.9, 0.05, (0.2, -0.4, 0.0)),
    )
    plan = BenchPlan(cameras={**NAVCAMS, "hazcam": HAZCAM}, placements=far, attitudes=9, checks=2)
    lonely = write_survey(simulate_bench(1, plan), tmp_path / "b").folder
    stands = Mast(np.array([0.31, -0.02, -1.42]), np.array([0.02, -0.03, 0.05]))
    save_rig(replace(TRUE, mast=stands), lonely / FORMER)
    code, answer = run(capsys, lonely, "--out", tmp_path / "m.yaml")
    assert code == 0, answer
    rig = load_rig(tmp_path / "m.yaml").rig
    assert any(
        "body camera hazcam is not tied to the head: it saw the board at 1 " in n for n in answer["notes"]
    )
    np.testing.assert_array_equal(rig.cameras["hazcam"].model.C, TRUE.cameras["hazcam"].model.C)
    np.testing.assert_allclose(rig.mast.translation_m, stands.translation_m, atol=1e-12)
    np.testing.assert_allclose(rig.mast.rotation_rad, stands.rotation_rad, atol=1e-12)


def test_a_placement_that_moved_is_left_out_with_a_sentence(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    survey = read_survey(folder)
    whole = bench_survey.fit_bench  # type: ignore[attr-defined]

    def finds_that_p1_moved(survey: Survey, **frame: Any) -> BenchCalibration:
        if any(image.placement == "p1" for image in survey.images):
            raise BoardMoved("board b1 moved during placement p1, between pictures a and b", "p1")
        return whole(survey, **frame)

    monkeypatch.setattr(bench_survey, "fit_bench", finds_that_p1_moved)
    done = fit_in_frame(survey, None, None)
    assert {placement for _, placement in done.rover_from_board} == {"p2", "p3"}
    (reason,) = [r for r in judge(survey, done).reasons if "placement p1" in r.sentence]
    assert reason.grade == "care" and "moved during placement p1, between pictures a and b" in reason.sentence


EXACT = pytest.mark.long(1, "the case of an exact print; an inexact one is in the quick run")


@pytest.mark.parametrize("print_m", [pytest.param(0.0, marks=EXACT), 1e-4])
def test_a_run_plans_with_corners_that_are_off_by_what_print_and_lens_add(print_m: float) -> None:
    survey = simulate_bench(1, BenchPlan(attitudes=9, checks=3, own_px=0.01, print_m=print_m))
    rms_px, scale = corner_noise(fit_bench(survey), survey)
    assert scale * 0.01 == pytest.approx(rms_px, rel=0.4)


def test_a_folder_gives_a_mast_file_with_joints_covariance_and_a_verdict(
    servo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "m.yaml"
    code, answer = run(capsys, servo, "--out", out)
    assert code == 0
    stored = load_rig(out)
    assert stored.digest == answer["mast_file"]["digest"]
    assert stored.rig.joints.pan.backlash_rad == pytest.approx(0.004, abs=1e-3)
    covariance = stored_covariance(stored.rig)
    assert covariance is not None and "joints.pan.backlash_rad" in covariance.names
    assert set(answer["rms_px"]) == set(answer["check_rms_px"]) == {"navcam_left", "navcam_right"}
    terms = {term["name"]: term for term in answer["terms"]}
    assert terms["pan backlash"]["entered"] and terms["pan backlash"]["chi2"] > 50
    assert answer["verdict"]["grade"] in ("good", "care")
    assert any("first pointing by navcam is uncertain" in r["sentence"] for r in answer["verdict"]["reasons"])
    assert 0 < answer["calibrated_px"] < 1.5 and 0.5 < answer["counts_px"] < 1.0
    assert "where the vehicle is, pictures cannot show" in answer["gauges"][0]
    assert stored.rig.fit["verdict"]["grade"] == answer["verdict"]["grade"]


def test_the_mast_stands_where_level_and_tape_say(
    servo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = tmp_path / "m.yaml", tmp_path / "again.yaml"
    code, answer = run(capsys, servo, "--out", first, "--mast-at", "0.3", "0", "-1.4", "0", "0.01", "0")
    assert code == 0
    assert answer["mast"]["translation_m"] == [0.3, 0.0, -1.4]
    code, answer = run(capsys, servo, "--out", second, "--mast-like", first)
    assert code == 0
    assert answer["mast"]["rotation_rad"] == pytest.approx([0.0, 0.01, 0.0], abs=1e-12)
    both = "--mast-like", first, "--mast-at", "0", "0", "0", "0", "0", "0"
    assert run(capsys, servo, "--out", second, *both)[0] == 2


@pytest.mark.long(1, "two processes, each with a fit of its own")
def test_a_fit_is_the_same_to_the_last_digit_in_every_process(servo: Path, tmp_path: Path) -> None:
    found = set()
    for seed in ("1", "2"):  # of Python's hashes, and so of the order of its sets
        command = [sys.executable, "-m", "mastctl", "calibrate", "bench", str(servo), "--json"]
        environment = {**os.environ, "PYTHONHASHSEED": seed}
        out = subprocess.check_output([*command, "--out", str(tmp_path / "m.yaml")], env=environment)
        found.add(json.loads(out)["chi2"])
    assert len(found) == 1


def test_a_joint_that_slipped_leaves_no_mast_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = replace(SERVO, backlash_rad=0.0, count_rad=0.0, mishaps=(Mishap("tilt", 14, 0.01),))
    write_survey(simulate_bench(1, plan), tmp_path / "b")
    code, answer = run(capsys, tmp_path / "b", "--out", tmp_path / "m.yaml")
    assert code == 1
    assert "tilt slipped by about 1" in answer["error"]["message"]
    assert not (tmp_path / "m.yaml").exists()
