"""The study of calibration: the same numbers wherever it runs, and what it shows."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from types import ModuleType

import numpy as np
import pytest

from calib.files.mast_file import load_rig
from calib.survey.records import Sigma
from hil_tests.mastctl.calibration.survey_world import RIG_FILE
from hil_tests.support.sim_survey.plan import SurveyPlan
from mastctl.experiment.tasks import NoExecutor, open_executor, run_tasks
from tools.studies.calibration import main, table_iv_rows, variant_rows
from tools.studies.calibration_survey import (
    SurveyOutcome,
    Variant,
    one_survey,
    survey_tasks,
)

PLAN = SurveyPlan(sigma=Sigma(0.002, 0.1))
CHOSEN = (
    Variant("mast parameters", "4", "paper", 4, PLAN),
    Variant("mast parameters", "6", "paper", 6, PLAN),
)


RIG = load_rig(RIG_FILE).rig


def run(executor: Executor, seed: int = 3, chosen: tuple[Variant, ...] = CHOSEN) -> tuple[SurveyOutcome, ...]:
    tasks = survey_tasks(RIG, surveys=1, targets=3, seed=seed, chosen=chosen)
    return tuple(run_tasks(executor, one_survey, tasks))


@pytest.fixture(scope="module")
def experiment() -> Iterator[tuple[SurveyOutcome, ...]]:
    with ThreadPoolExecutor(1) as executor:
        yield run(executor)


def test_six_parameters_fit_where_four_do_not(experiment: tuple[SurveyOutcome, ...]) -> None:
    four, six = variant_rows(RIG, experiment)
    assert max(max(xy) for xy in six["mast_rms_px"].values()) < 2.0
    assert max(max(xy) for xy in four["mast_rms_px"].values()) > 5.0, "the paper's Table V: 22 px"
    assert six["exact_px"] < 0.5 * four["exact_px"]
    true = [round(value, 4) for value in table_iv_rows(RIG, [four, six])[0]["numbers"]]
    assert true == [0.3443, -0.0043, -1.4572, -0.0088, -0.0181, 0.0027]


def test_rms_and_worst_are_those_of_the_surveys_by_hand() -> None:
    """Two surveys whose errors are whole numbers."""
    outcomes = [
        SurveyOutcome(
            CHOSEN[1],
            pointing_px={d: np.array([[3.0, 1.0]]) for d in (10.0, 6.0, 2.0)},
            exact_px={d: np.array([[sign, 0.0]]) for d in (10.0, 6.0, 2.0)},
            handoff_px={("navcam to hazcam", 2.0): np.array([[3.0 * sign, 4.0]])},
            mast=np.array(
                [0.3443 + 0.01 * sign, *RIG.mast.translation_m[1:], *RIG.mast.rotation_rad, 0.0, 0.0]
            ),
            sigma=np.full(8, 0.01),
        )
        for sign in (1.0, -1.0)
    ]
    (row,) = variant_rows(RIG, outcomes)
    assert row["pointing_rms_px"]["6"] == (3.0, 1.0)
    assert row["pointing_px"] == pytest.approx(np.sqrt(5.0))
    assert row["exact_px"] == pytest.approx(np.sqrt(0.5))
    assert row["to_hazcam_worst_px"] == 5.0 and "to_navcam_px" not in row
    assert row["mast_error"][0] == pytest.approx(0.01, abs=1e-4)


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
