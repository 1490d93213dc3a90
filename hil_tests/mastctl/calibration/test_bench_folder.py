"""``mastctl calibrate bench FOLDER``: a bench's folder fitted again, and what is told of it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.files.mast_file import load_rig
from calib.geometry.covariance import stored_covariance
from calib.survey.writer import write_survey
from hil_tests.support.sim_survey.bench import BenchPlan, Mishap, simulate_bench
from mastctl.cli.main import main

PLAN = BenchPlan(attitudes=9, checks=3, backlash_rad=0.004, count_rad=2 * np.pi / 4096)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A servo's bench."""
    return write_survey(simulate_bench(1, PLAN), tmp_path_factory.mktemp("bench") / "b").folder


def run(capsys: pytest.CaptureFixture[str], *words: str | Path) -> tuple[int, Any, str]:
    """Exit code, JSON and stderr of a command."""
    capsys.readouterr()
    code = main([str(word) for word in ("calibrate", "bench", *words, "--json")])
    out, err = capsys.readouterr()
    return code, json.loads(out) if out else None, err


def test_a_folder_gives_a_mast_file_with_joints_covariance_and_a_verdict(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "m.yaml"
    code, told, _ = run(capsys, folder, "--out", out)
    assert code == 0
    stored = load_rig(out)
    assert stored.digest == told["mast_file"]["digest"]
    assert stored.rig.joints.pan.backlash_rad == pytest.approx(0.004, abs=1e-3)
    covariance = stored_covariance(stored.rig)
    assert covariance is not None and "joints.pan.backlash_rad" in covariance.names
    assert set(told["rms_px"]) == set(told["check_rms_px"]) == {"navcam_left", "navcam_right"}
    terms = {term["name"]: term for term in told["terms"]}
    assert terms["pan backlash"]["entered"] and terms["pan backlash"]["chi2"] > 50
    assert told["verdict"]["grade"] in ("good", "care")
    assert any("first pointing by navcam is uncertain" in r["sentence"] for r in told["verdict"]["reasons"])
    assert 0 < told["predicted_px"] < 1.5 and 0.5 < told["counts_px"] < 1.0
    assert "where the vehicle is, pictures cannot show" in told["gauges"][0]
    assert stored.rig.fit["verdict"]["grade"] == told["verdict"]["grade"]


def test_the_mast_stands_where_level_and_tape_say(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = tmp_path / "m.yaml", tmp_path / "again.yaml"
    code, told, _ = run(capsys, folder, "--out", first, "--mast-at", "0.3", "0", "-1.4", "0", "0.01", "0")
    assert code == 0
    assert told["mast"]["translation_m"] == [0.3, 0.0, -1.4]
    code, told, _ = run(capsys, folder, "--out", second, "--mast-like", first)
    assert code == 0
    assert told["mast"]["rotation_rad"] == pytest.approx([0.0, 0.01, 0.0], abs=1e-12)
    both = "--mast-like", first, "--mast-at", "0", "0", "0", "0", "0", "0"
    assert run(capsys, folder, "--out", second, *both)[0] == 2


def test_a_joint_that_slipped_leaves_no_mast_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = replace(PLAN, backlash_rad=0.0, count_rad=0.0, mishaps=(Mishap("tilt", 14, 0.01),))
    write_survey(simulate_bench(1, plan), tmp_path / "b")
    code, told, _ = run(capsys, tmp_path / "b", "--out", tmp_path / "m.yaml")
    assert code == 1
    assert "tilt slipped by about 1" in told["error"]["message"]
    assert not (tmp_path / "m.yaml").exists()
