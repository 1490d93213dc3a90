"""``mastctl calibrate`` that is killed, or finds the disk full: no half-written file, nothing lost."""

from __future__ import annotations

import json
import os
import pickle
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from calib.adjust.result import Calibration
from calib.calibrate.paper import fit_paper
from calib.files.mast_file import load_rig, save_rig
from calib.survey.reader import read_survey
from hil_tests.mastctl.calibration.survey_world import navcam_rig, navcam_survey, write_folder
from mastctl.calibration import run as calibration_run
from mastctl.calibration.run import FITS
from mastctl.cli.main import main
from mastctl.report import pages, pictures

FITTED = """
import pickle, sys
from mastctl.calibration import run
from mastctl.cli.main import main
from mastctl.report import pictures
with open(sys.argv[1], "rb") as kept:
    fit = pickle.load(kept)
run.FITS["paper"] = run.fit_joint = lambda *ignored: fit
pictures.can_plot = lambda: False
"""
"""The command in a process of its own, with a fit that is there already and a report of words alone."""

FILE_LIMIT_BYTES = 20_000
"""Less than a mast file with its covariance."""


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(navcam_survey(1)[0], tmp_path_factory.mktemp("survey") / "s")


@pytest.fixture(scope="module")
def fitted(survey: Path) -> Calibration:
    return fit_paper(read_survey(survey))


@pytest.fixture(scope="module")
def kept(fitted: Calibration, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The fit for processes of their own."""
    path = tmp_path_factory.mktemp("fit") / "fit.pickle"
    path.write_bytes(pickle.dumps(fitted))
    return path


@pytest.fixture(autouse=True)
def one_fit(fitted: Calibration, monkeypatch: pytest.MonkeyPatch) -> None:
    """The survey is fitted once, and no plot is drawn: what comes after the fit is tried here."""
    monkeypatch.setitem(FITS, "paper", lambda survey, mast_parameters: fitted)
    monkeypatch.setattr(calibration_run, "fit_joint", lambda survey, mast_parameters: fitted)
    monkeypatch.setattr(pictures, "can_plot", lambda: False)


def words(survey: Path, out: Path, *more: str) -> list[str]:
    return ["calibrate", str(survey), "--out", str(out), "--method", "paper", "--json", *more]


def run(code: str, *argv: str, **options: Any) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-B", "-c", code, *argv]  # -B: 3.11 keeps a module that a full disk cuts
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, **options)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def test_a_full_disk_leaves_everything_as_it_was(survey: Path, kept: Path, tmp_path: Path) -> None:
    out = tmp_path / "m.yaml"
    save_rig(navcam_rig(), out)
    save_rig(navcam_rig(), out)
    before = contents(tmp_path)

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (FILE_LIMIT_BYTES, FILE_LIMIT_BYTES))

    code = FITTED + "sys.exit(main(sys.argv[2:]))"
    uncounted = {key: value for key, value in os.environ.items() if not key.startswith("COV")}
    done = run(code, str(kept), *words(survey, out), preexec_fn=limit, env=uncounted)
    assert done.returncode == 2, done.stderr
    assert "cannot be saved: File too large" in json.loads(done.stdout)["error"]["message"]
    assert "Traceback" not in done.stderr
    assert contents(tmp_path) == before


def test_a_report_that_cannot_be_written_does_not_hide_the_mast_file(
    survey: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*ignored: Any, **answer: Any) -> str:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pages, "page", full)
    out = tmp_path / "m.yaml"
    assert main(words(survey, out, "--report", str(tmp_path / "r"))) == 1
    error = json.loads(capsys.readouterr().out)["error"]
    assert error["code"] == "report_not_written"
    assert f"the mast file {out} is saved" in error["message"]
    load_rig(out)
