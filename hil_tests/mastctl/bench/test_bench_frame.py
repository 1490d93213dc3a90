"""Where the rover frame of a bench is: by a level and a tape, a board at a known place, or body cameras."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.adjust.result import BenchCalibration
from calib.calibrate.bench import fit_bench
from calib.calibrate.starts.bench import BenchNotFitted
from calib.files.mast_file import load_rig, save_rig
from calib.geometry.rig import Mast, Rig
from calib.survey.reader import read_survey
from calib.survey.records import Survey
from calib.survey.writer import write_survey
from hil_tests.support.sim_survey.bench import NAVCAMS, BenchCamera, BenchPlan, Placement, simulate_bench
from mastctl.bench import survey as bench_survey
from mastctl.bench.known import corner_noise
from mastctl.bench.survey import FORMER, RoverFrame, fit_in_frame
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
STANDS = Mast(np.array([0.31, -0.02, -1.42]), np.array([0.02, -0.03, 0.05]))
ELSEWHERE = STANDS.rover_from_mast
P_IN_ROVER_M = np.array([3.0, 0.4, -1.0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bench whose mast stands at the rover's origin, with a body camera that sees every placement."""
    plan = BenchPlan(cameras={**NAVCAMS, "hazcam": HAZCAM}, placements=LOW, attitudes=9, checks=2)
    return write_survey(simulate_bench(1, plan), tmp_path_factory.mktemp("bench") / "b").folder


TRUE = BenchPlan(cameras={**NAVCAMS, "hazcam": HAZCAM}).rig


def fitted(capsys: pytest.CaptureFixture[str], folder: Path, out: Path, *words: object) -> tuple[Rig, Any]:
    """The rig that the command makes, and what it tells."""
    capsys.readouterr()
    code = main(["calibrate", "bench", str(folder), "--out", str(out), *map(str, words), "--json"])
    printed, _ = capsys.readouterr()
    told = json.loads(printed)
    assert code == 0, told
    return load_rig(out).rig, told


def off_px(rig: Rig, true: Rig) -> float:
    """How far apart two rigs see one point of the rover frame with the left Navcam."""
    points = P_IN_ROVER_M[None]
    seen = [one.camera_in_rover("navcam_left", 0.1, -0.05).project(points)[0] for one in (rig, true)]
    return float(np.abs(seen[0] - seen[1]).max())


def moved(true: Rig) -> Rig:
    """The true rig on a rover whose mast stands as STANDS says."""
    cameras = {
        n: replace(c, model=c.model.moved(ELSEWHERE)) if c.on == "rover" else c
        for n, c in true.cameras.items()
    }
    return replace(true, mast=STANDS, cameras=cameras)


@pytest.mark.long(2, "a whole driven bench with body cameras")
def test_board_level_tape_and_body_cameras_give_the_true_rover_frame(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, true = tmp_path / "m.yaml", moved(TRUE)
    tape = [*STANDS.translation_m, *STANDS.rotation_rad]
    rig, _ = fitted(capsys, folder, out, "--mast-at", *tape)
    assert off_px(rig, true) < 1.0
    board = ELSEWHERE @ LOW[0].mast_from_board
    upright = np.column_stack([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    turns = Rotation.from_matrix(board.rotation @ upright.T).as_euler("ZYX", degrees=True)
    rig, told = fitted(capsys, folder, out, "--board-at", *board.translation_m, *turns)
    assert off_px(rig, true) < 1.0
    assert "hangs on placement p1" in told["gauges"][0]
    save_rig(true, folder / FORMER)
    try:
        rig, told = fitted(capsys, folder, out, "--body-stays")
        assert off_px(rig, true) < 2.0  # by one small body camera
        assert any("where the former mast file has hazcam" in note for note in told["notes"])
        rig, _ = fitted(capsys, folder, out)  # as its run had it: where the former mast file has the mast
        assert off_px(rig, true) < 1.0
    finally:
        (folder / FORMER).unlink()


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
    save_rig(TRUE, lonely / FORMER)
    rig, told = fitted(capsys, lonely, tmp_path / "m.yaml")
    assert any(
        "body camera hazcam is not tied to the head: it saw the board at 1 " in n for n in told["notes"]
    )
    np.testing.assert_array_equal(rig.cameras["hazcam"].model.C, TRUE.cameras["hazcam"].model.C)


def test_a_placement_that_moved_is_left_out_with_a_sentence(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    survey = read_survey(folder)
    whole = bench_survey.fit_bench  # type: ignore[attr-defined]

    def fits_only_without_p1(survey: Survey) -> BenchCalibration:
        if any(image.placement == "p1" for image in survey.images):
            raise BenchNotFitted("the fit leaves 24.6 times the stated noise of a corner")
        return whole(survey)

    monkeypatch.setattr(bench_survey, "fit_bench", fits_only_without_p1)
    with pytest.raises(BenchNotFitted, match=r"24\.6 times"):
        fit_in_frame(survey, RoverFrame(), None)
    done = fit_in_frame(survey, RoverFrame(), None, moved={"p1": 24.7})
    assert {placement for _, placement in done.rover_from_board} == {"p2", "p3"}
    (reason,) = [r for r in judge(survey, done).reasons if "placement p1" in r.sentence]
    assert reason.grade == "care" and "shows the board 24.7 px aside" in reason.sentence


EXACT = pytest.mark.long(1, "the case of an exact print; an inexact one is in the quick run")


@pytest.mark.parametrize("print_m", [pytest.param(0.0, marks=EXACT), 1e-4])
def test_a_run_plans_with_corners_that_are_off_by_what_print_and_lens_add(print_m: float) -> None:
    survey = simulate_bench(1, BenchPlan(attitudes=9, checks=3, own_px=0.01, print_m=print_m))
    rms_px, scale = corner_noise(fit_bench(survey), survey)
    assert scale * 0.01 == pytest.approx(rms_px, rel=0.4)
