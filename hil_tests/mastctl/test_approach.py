"""The approach experiment's own arithmetic; the runs themselves are a command."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.store import load_rig
from mastctl.experiment.approach import (
    ApproachRun,
    Stop,
)
from mastctl.experiment.approach_report import (
    handoffs,
    losses,
    strip,
    summary,
    table_rows,
    write_record,
    write_strip,
)
from mastctl.experiment.approach_world import WINDOW_PX, windowed


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
    assert math.isclose(found["final_right_rms_m"], math.sqrt(0.002**2 / 3))
    assert math.isclose(found["untracked_along_rms_m"], 0.1)
    assert (found["losses"], found["recoveries"], found["handoffs"]) == (1, 0, 0)
    assert [found[f"stops_from_{low}_m"] for low in (6, 2, 0)] == [0, 1, 3]
    headings, rows = table_rows(runs)
    assert headings[1:3] == ["eqs. (1)-(4)", "paper"]
    assert [row[1:3] for row in rows[:3]] == [["9.7", "9.7"], ["22.2", "22.2"], ["1.45", "1.5"]]
    assert rows[2][4] == f"{300 * math.sqrt(0.002**2 / 3):.2f}"


def test_handoffs_and_recoveries_are_counted() -> None:
    pairs = [("pancam", "tracked"), ("navcam", "lost"), ("navcam", "tracked"), ("hazcam", "tracked")]
    run = ApproachRun(
        1, tuple(replace(stop(2.0, (0.0, 0.0, 0.0), state), pair=pair) for pair, state in pairs)
    )
    assert handoffs(run) == 2
    assert losses(run) == (1, 1)


def test_a_window_shows_the_middle_of_the_picture(repository: Path) -> None:
    rig = load_rig(repository / "configs/sim/rocky8.yaml").rig
    cut = windowed(rig, WINDOW_PX)
    for name in ("pancam_left", "navcam_right"):
        whole, part = rig.cameras[name].model, cut.cameras[name].model
        rays = whole.ray(np.array([500.0, 400.0]))
        place, valid = part.project(rays.origins_m + 5.0 * rays.directions)
        assert bool(valid)
        assert np.allclose(place + (np.array(whole.size_px) - part.size_px) / 2, [500.0, 400.0], atol=1e-6)
    assert cut.cameras["hazcam_left"].model is rig.cameras["hazcam_left"].model


def test_a_strip_shows_every_stop_and_where_it_was_lost(tmp_path: Path) -> None:
    patch = np.full((5, 5), 100, np.uint8)
    one = replace(stop(3.0, (0.0, 0.0, 0.0)), patches=(patch, patch, patch))
    run = ApproachRun(7, (one, replace(one, state="lost")))
    picture = strip(run)
    assert picture.shape == (16 + 3 * 10, 2 * 10, 3)
    found, missed = picture[26, 0].tolist(), picture[26, 10].tolist()
    assert found[1] > found[2] and missed[2] > missed[1]  # green frame, red frame
    write_strip(run, tmp_path)
    assert (tmp_path / "strip_7.png").exists()


def test_the_record_holds_every_stop(tmp_path: Path) -> None:
    runs = [ApproachRun(1, (stop(1.05, (0.001, 0.0, 0.0)),)), ApproachRun(2, (), "no view")]
    write_record(runs, tmp_path / "new")
    rows = list(csv.DictReader((tmp_path / "new/stops.csv").open()))
    assert [row["range_m"] for row in rows] == ["1.05"]
    document = json.loads((tmp_path / "new/record.json").read_text())
    assert document["runs"][1]["error"] == "no view"
