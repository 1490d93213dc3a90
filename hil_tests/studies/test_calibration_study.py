"""The study of calibration: the same numbers wherever it runs, and what it shows."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from calib.adjust.result import Calibration
from calib.adjust.robust import SurveyNotFitted
from calib.files.mast_file import load_rig
from calib.survey.records import Sigma, Survey
from hil_tests.mastctl.calibration.survey_world import RIG_FILE
from mastctl.calibration.run import FITS
from mastctl.experiment.tasks import NoExecutor, Work, open_executor
from tools.sim_survey.plan import SurveyPlan
from tools.studies.calibration import main, study_as_json, table_iv, table_v, write_study_report
from tools.studies.calibration_survey import (
    CalibrationExperiment,
    SurveyOutcome,
    SurveyTask,
    Variant,
    one_survey,
    survey_tasks,
    variants,
)

PLAN = SurveyPlan(sigma=Sigma(0.002, 0.1))
CHOSEN = (
    Variant("mast parameters", "4", 4, "paper", 4, PLAN),
    Variant("mast parameters", "6", 6, "paper", 6, PLAN),
)


def run(executor: Executor, seed: int = 3, chosen: tuple[Variant, ...] = CHOSEN) -> CalibrationExperiment:
    rig = load_rig(RIG_FILE).rig
    tasks = survey_tasks(rig, surveys=1, targets=3, seed=seed, chosen=chosen)
    return CalibrationExperiment(rig, seed, 1, outcomes(executor, tasks), 0.0)


def outcomes(executor: Executor, tasks: Sequence[SurveyTask]) -> tuple[SurveyOutcome, ...]:
    work = Work(one_survey, tasks, lambda task: task.variant.label)
    return tuple(work.run(lambda: nullcontext(executor)))


@pytest.fixture(scope="module")
def experiment() -> Iterator[CalibrationExperiment]:
    with ThreadPoolExecutor(1) as executor:
        yield run(executor)


def numbers(experiment: CalibrationExperiment) -> dict[str, Any]:
    """All of it but how long it took."""
    told = study_as_json(experiment)
    told.pop("seconds")
    for variant in told["variants"]:
        variant.pop("fit_seconds")
    return told


def test_another_seed_gives_other_numbers(experiment: CalibrationExperiment) -> None:
    with ThreadPoolExecutor(1) as executor:
        other = run(executor, seed=4, chosen=CHOSEN[1:])
    (there,), here = numbers(other)["variants"], numbers(experiment)["variants"][1]
    assert there["label"] == here["label"] and there != here


def test_six_parameters_fit_where_four_do_not(experiment: CalibrationExperiment) -> None:
    rows = {row[0]: row for row in table_v(experiment)[1]}
    six, four = (max(map(float, rows[f"{n} parameters"][1].split(", "))) for n in (6, 4))
    assert six < 2.0
    assert four > 5.0, "the paper's Table V: 22 px"
    by_parameters = {s.variant.mast_parameters: s for s in experiment.summaries}
    assert by_parameters[6].exact_px < 0.5 * by_parameters[4].exact_px
    iv = {row[0]: row[1:] for row in table_iv(experiment)[1]}
    assert iv["true"] == ["+0.3443", "-0.0043", "-1.4572", "-0.0088", "-0.0181", "+0.0027"]


def test_the_study_varies_one_thing_at_a_time() -> None:
    found = variants()
    base = SurveyPlan()
    for variant in found:
        differing = [
            name
            for name in ("rings", "mast_boards", "prisms", "noise", "attitudes", "check_boards", "pan_rad")
            if getattr(variant.plan, name) != getattr(base, name)
        ]
        assert len(differing) + (variant.plan.sigma != base.sigma) <= 1, variant
    studies = {variant.study for variant in found}
    both = {f"{study}, {method}" for study in ("placements", "boards", "station") for method in FITS}
    assert studies == both | {"prisms", "hazcam boards", "mast parameters"}
    assert {5, 8} <= {v.value for v in found if v.study == "placements, paper"}


def test_variants_are_compared_on_the_same_surveys(experiment: CalibrationExperiment) -> None:
    """What differs between two variants is what they vary, and not the draw."""
    with ThreadPoolExecutor(1) as executor:
        (other,) = run(executor, chosen=(replace(CHOSEN[1], label="again"),)).outcomes
    one = experiment.outcomes[1]
    np.testing.assert_array_equal(one.mast, other.mast)
    np.testing.assert_array_equal(one.exact_px[6.0], other.exact_px[6.0])


def test_a_survey_that_cannot_be_fitted_is_counted_and_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def lost(survey: Survey, mast_parameters: int) -> Calibration:
        raise SurveyNotFitted("camera navcam_left: no start was found")

    monkeypatch.setitem(FITS, "paper", lost)
    with ThreadPoolExecutor(1) as executor:
        found = run(executor)
    assert [summary.failed for summary in found.summaries] == [1, 1]
    assert "no start was found" in write_study_report(found, tmp_path).read_text()


def test_the_report_and_the_document(experiment: CalibrationExperiment, tmp_path: Path) -> None:
    page = write_study_report(experiment, tmp_path).read_text()
    assert "Table V" in page and "data:image/png" in page
    record = json.loads((tmp_path / "record.json").read_text())
    assert record["variants"][1]["mast_parameters"] == 6
    assert set(record["variants"][1]["pointing_rms_px"]) == {"10", "6", "2"}
    assert set(record["variants"][1]["handoff_worst_px"]) == {
        "pancam to navcam, 10 m",
        "pancam to navcam, 6 m",
        "pancam to navcam, 2 m",
        "navcam to hazcam, 2 m",
    }
    assert (tmp_path / "surveys.csv").read_text().count("\n") > 10


def test_the_command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    few = tuple(replace(v, study="prisms") for v in CHOSEN[1:])
    monkeypatch.setattr("tools.studies.calibration.variants", lambda: few)
    words = ["--study", "prisms", "--cases", "1", "--targets", "2"]
    assert main([*words, "--workers", "1", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [v["study"] for v in told["variants"]] == ["prisms"]


# Executors


def test_linear_algebra_has_one_thread_in_every_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sums of more threads differ in their last digits, and so would the study's numbers."""
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    names = ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"]
    with open_executor("local", 1) as executor:
        assert list(executor.map(os.getenv, names)) == ["1", "1"]
    assert list(map(os.getenv, names)) == ["3", None]


@pytest.mark.parametrize("name", ["dask", "dask:", "threads", ""])
def test_an_unknown_executor_is_refused(name: str) -> None:
    with pytest.raises(NoExecutor, match="local or dask:ADDRESS"), open_executor(name):
        pass


def test_dask_without_its_package_is_refused_plainly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(NoExecutor, match="pip install distributed") as refused:
        main(["--executor", "dask:tcp://127.0.0.1:1", "--json"])
    assert (refused.value.code, refused.value.exit_code) == ("no_executor", 2)


def test_a_silent_scheduler_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def silent(address: str, timeout: float) -> None:
        raise OSError("timed out")

    module = ModuleType("distributed")
    module.Client = silent  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "distributed", module)
    with (
        pytest.raises(NoExecutor, match="no Dask scheduler answers at tcp://x:1"),
        open_executor("dask:tcp://x:1"),
    ):
        pass


def test_numbers_are_not_all_the_same(experiment: CalibrationExperiment) -> None:
    errors = np.concatenate([o.exact_px[6.0] for o in experiment.outcomes])
    assert len(np.unique(errors)) == errors.size
