"""The approach experiment's own arithmetic; the runs themselves are a command."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import numpy as np

from mastctl.experiment.approach import (
    ApproachRun,
    Stop,
    summary,
    table_rows,
    write_record,
)


def stop(range_m: float, error_m: tuple[float, float, float], state: str = "tracked") -> Stop:
    return Stop(range_m, "hazcam", state, "", np.array(error_m), np.full(3, 0.003), 0.3, False)


def test_runs_are_counted_and_averaged_by_hand() -> None:
    runs = [
        ApproachRun(1, (stop(5.0, (0.02, 0.0, 0.0)), stop(1.05, (0.003, 0.0, 0.001)))),
        ApproachRun(2, (stop(1.05, (-0.004, 0.002, 0.0)),)),
        ApproachRun(3, (stop(4.0, (0.0, 0.0, 0.0), "lost"),)),
        ApproachRun(4, (), "no view offered a target"),
        ApproachRun(5, (stop(1.05, (0.5, 0.0, 0.0)),)),
    ]
    found = summary(runs)
    assert (found["runs"], found["kept"], found["silently_wrong"]) == (5, 3, 1)
    assert math.isclose(found["right_rms_m"], math.sqrt(0.002**2 / 3))
    theory = [row[2] for row in table_rows(runs)[1] if row[2]]
    assert theory == ["1.45"]


def test_the_record_holds_every_stop(tmp_path: Path) -> None:
    runs = [ApproachRun(1, (stop(1.05, (0.001, 0.0, 0.0)),)), ApproachRun(2, (), "no view")]
    write_record(runs, tmp_path / "new")
    rows = list(csv.DictReader((tmp_path / "new/stops.csv").open()))
    assert [row["range_m"] for row in rows] == ["1.05"]
    document = json.loads((tmp_path / "new/record.json").read_text())
    assert document["runs"][1]["error"] == "no view"
