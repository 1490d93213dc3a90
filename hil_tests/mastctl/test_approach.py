"""The approach experiment's own arithmetic; the runs themselves are a command."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest

from calib.errors import CalibError
from calib.store import load_rig
from mastctl.experiment.approach import (
    HANDOFFS_M,
    ApproachRun,
    Stop,
    choose_pair,
)
from mastctl.experiment.approach_report import summary, table_rows, write_record


def stop(range_m: float, error_m: tuple[float, float, float], state: str = "tracked") -> Stop:
    return Stop(
        range_m,
        "hazcam",
        state,
        "",
        np.array(error_m),
        np.full(3, 0.003),
        0.3,
        False,
        np.array([0.1, 0.0, 0.0]),
    )


@pytest.mark.parametrize(("range_m", "pair"), [(9.0, "pancam"), (4.0, "navcam"), (1.0, "hazcam")])
def test_the_pair_follows_from_the_range(repository: Path, range_m: float, pair: str) -> None:
    rig = load_rig(repository / "configs/sim/rocky8.yaml").rig
    name, pan, tilt = choose_pair(rig, np.array([0.5 + range_m, 0.3, 0.0]), HANDOFFS_M)
    assert name == pair
    if pair != "hazcam":
        pixel, _ = rig.camera_in_rover(f"{pair}_left", pan, tilt).project(np.array([0.5 + range_m, 0.3, 0.0]))
        assert np.allclose(pixel, rig.cameras[f"{pair}_left"].model.image_center_px, atol=1e-6)


def test_a_target_behind_the_rover_is_seen_by_the_head_only(repository: Path) -> None:
    rig = load_rig(repository / "configs/sim/rocky8.yaml").rig
    assert choose_pair(rig, np.array([-1.5, 0.2, 0.0]), HANDOFFS_M)[0] == "navcam"
    with pytest.raises(CalibError, match="no stereo pair sees the target"):
        choose_pair(rig, np.array([-1.5, 0.2, 0.0]), {"hazcam": 0.0})


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
