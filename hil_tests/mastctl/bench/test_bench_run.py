"""A whole bench on corners: from a drawing to a rig that points, killed on the way, disturbed on the way."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bench_of_corners import CornerBench
from bench_world import corner_bench, one_camera, run_of

from calib.calibrate.starts.bench import SomethingChanged
from calib.errors import CalibError
from calib.files.mast_file import load_rig
from calib.geometry.rig import Rig
from calib.geometry.rigid import Rigid
from calib.plan.knowledge import BenchShot, Knowledge, Workspace, pointing
from calib.plan.placements import Placement
from calib.survey.reader import read_survey
from mastctl.bench.eyes import BenchLook
from mastctl.bench.folder import looks_of
from mastctl.bench.looks import BenchGoal, BoardLost
from mastctl.bench.run import BenchRun
from mastctl.bench.search import BoardNotFound


def test_a_bench_ends_by_itself_with_what_was_wanted_met_on_paper_and_kept(
    repository: Path, tmp_path: Path
) -> None:
    bench = corner_bench(repository)
    run, teller = run_of(bench, tmp_path / "bench")
    fitted = run.run()
    assert run.known.predicted_px() <= 0.2 and run.known.pictures() <= 60 and bench.seconds < 240.0
    survey = read_survey(tmp_path / "bench")
    looks = list(looks_of(survey))
    assert 2 <= len({placement for placement, _, _ in looks}) <= 4
    assert not any(check for _, check, _ in looks)
    checked = run.check()
    assert len(checked.pointings) >= 3
    x, y = checked.pointing_rms_px or (9.0, 9.0)
    assert max(x, y) < 0.3
    assert checked.pointing_promised_px == pytest.approx(0.15, abs=0.12)
    assert any(check for _, check, _ in looks_of(read_survey(tmp_path / "bench")))
    for name, true in bench.true_rig.cameras.items():
        np.testing.assert_allclose(fitted.rig.cameras[name].model.H, true.model.H, atol=8.0)
    assert any("p2" in line for line in teller.told)


@pytest.mark.long(2, "a whole driven bench with one camera")
def test_a_single_camera_is_calibrated_the_same_way_and_pointed_by_the_range_of_the_board_that_stands_there(
    repository: Path, tmp_path: Path
) -> None:
    bench = corner_bench(repository, of=one_camera)
    run, _ = run_of(bench, tmp_path / "bench")
    run.run()
    assert run.known.predicted_px() <= 0.2 and len(run.known.placements()) >= 2
    checked = run.check()
    assert len(checked.pointings) >= 3
    x, y = checked.pointing_rms_px or (9.0, 9.0)
    assert max(x, y) < 3.0 * (checked.pointing_promised_px or 0.0) < 1.0


def whole_rover(repository: Path) -> tuple[Rig, Rig]:
    """Three pairs: two on the head, one of them of a narrow view, and one on the body."""
    true = load_rig(repository / "configs/sim/rocky8.yaml").rig
    believed = load_rig(repository / "configs/masts/rocky8_simulated.yaml").rig
    return replace(true, provenance={}), replace(believed, provenance={}, fit={})


def test_a_camera_that_cannot_show_the_board_or_has_seen_it_stand_takes_no_picture(
    repository: Path, tmp_path: Path
) -> None:
    bench = corner_bench(repository, of=whole_rover)
    run, _ = run_of(bench, tmp_path / "bench")
    known, looks, every = run.known, run._looks, tuple(bench.head.rig.cameras)
    bench.stand(Placement(1.3, 0.0, -35.0, (10.0, 0.0)))
    known.take("p1", bench.look(0.0, -0.6))
    beside, at_it = BenchShot("p1", 0.7, -0.6, ()), BenchShot("p1", 0.0, -0.6, ())
    navcams, pancams = ({name for name in every if kind in name} for kind in ("nav", "pan"))
    assert run.choice_s() > 0.0
    for shot in (at_it, beside, at_it):
        look = looks.look_at(shot)
        assert look is not None and {"hazcam_left", *navcams} <= set(look.cameras)
        known.take("p1", look)
    assert set(looks.look_at(at_it).cameras) == navcams | pancams, "hazcams stand still before it"
    for shot in known.round_others("p1"):
        look = looks.look_at(shot)
        assert look is not None
        known.take("p1", look)
    for pancam in pancams:
        tilts = [look.tilt_rad for look in known.of("p1") if pancam in {one.camera for one in look.found}]
        assert len(tilts) >= 4 and np.ptp(tilts) > np.radians(11.0), "what a fit of its place needs"
    assert not list(known.round_others("p1"))
    known.end()
    known.fitted = object()  # type: ignore[assignment]  # the estimate is good now
    assert set(looks.look_at(beside).cameras) == navcams, "it is beside the narrow view"
    assert set(looks.look_at(at_it, check=True).cameras) == set(every), "a check is of each of them"


def test_before_a_run_it_is_told_what_its_pictures_take() -> None:
    took_s = {"navcam_left": 1.0, "navcam_right": 1.0, "pancam_left": 2.0}
    words = BenchGoal(pictures=60).will_take(took_s, ("navcam_left", "navcam_right"), 0.5)
    # 21 looks of 1.5 s to turn, 0.5 s to choose and two pictures; 60 looks with all three
    assert words.startswith("21 to 60 looks will take 1.4 to 6 minutes here. One of all 3 cameras 6.0 s")
    assert (
        "(pancam_left 2.0 s, the choice of the next 0.5 s), of navcam_left, navcam_right alone 4.0 s" in words
    )


class Dying(RuntimeError):
    """Stands for a kill between two looks."""


class Mortal:
    """Eyes that die after some looks."""

    def __init__(self, bench: CornerBench, looks: int) -> None:
        self.bench, self.left, self.head = bench, looks, bench.head

    def look(self, pan_rad: float, tilt_rad: float, approach: tuple[int, int] = (0, 0)) -> BenchLook:
        if not self.left:
            raise Dying
        self.left -= 1
        return self.bench.look(pan_rad, tilt_rad, approach)


def test_a_run_that_died_goes_on_at_the_same_placement_without_asking_again(
    repository: Path, tmp_path: Path
) -> None:
    bench = corner_bench(repository, seed=2)
    run, _ = run_of(bench, tmp_path / "bench", eyes=Mortal(bench, 5))  # dies in the first placement
    with pytest.raises(Dying):
        run.run()
    run._kept.let_go()
    before = list(looks_of(read_survey(tmp_path / "bench")))
    again, second = run_of(bench, tmp_path / "bench", eyes=Mortal(bench, 3))  # its end is that of any run
    with pytest.raises(Dying):
        again.run()
    after = list(looks_of(read_survey(tmp_path / "bench")))
    assert len(before) == 5 and [p for p, _, _ in after][:5] == [p for p, _, _ in before]
    assert len(after) > 5 and after[5][0] == before[4][0], "it goes on at the same placement"
    assert any("stands as it stood" in line for line in second.told)
    assert not any(line.startswith("p1: straight ahead") for line in second.told)


@pytest.mark.long(2, "a whole driven bench; the run that goes on is tested in the quick run")
def test_a_board_that_moved_while_the_run_was_dead_begins_another_placement(
    repository: Path, tmp_path: Path
) -> None:
    bench = corner_bench(repository, seed=3)
    run, _ = run_of(bench, tmp_path / "bench", eyes=Mortal(bench, 5))
    with pytest.raises(Dying):
        run.run()
    run._kept.let_go()
    assert bench.rover_from_board is not None
    aside = bench.rover_from_board.translation_m + np.array([0.0, 0.02, 0.0])
    bench.rover_from_board = Rigid(bench.rover_from_board.rotation, aside)
    again, second = run_of(bench, tmp_path / "bench")
    again.run()
    assert any("does not stand any more" in line for line in second.told)
    assert {p for p, _, _ in looks_of(read_survey(tmp_path / "bench"))} >= {"p1", "p2"}


def test_a_board_that_is_nowhere_is_told_in_one_sentence(repository: Path, tmp_path: Path) -> None:
    bench = corner_bench(repository)
    run, teller = run_of(bench, tmp_path / "bench")
    teller.place = lambda *_: None  # type: ignore[method-assign]  # nobody places it
    with pytest.raises(BoardNotFound, match=r"was not found in .* looks all over the head's limits"):
        run.run()
    assert not read_survey(tmp_path / "bench").images


def test_a_board_that_is_taken_away_ends_the_run_and_loses_nothing(repository: Path, tmp_path: Path) -> None:
    bench = corner_bench(repository)
    run, _ = run_of(bench, tmp_path / "bench")
    looked = bench.look
    taken = 0

    def look(pan_rad: float, tilt_rad: float, approach: tuple[int, int] = (0, 0)) -> BenchLook:
        nonlocal taken
        taken += 1
        if taken == 6:
            bench.rover_from_board = None
        return looked(pan_rad, tilt_rad, approach)

    bench.look = look  # type: ignore[method-assign]
    with pytest.raises(BoardLost, match="Put it back or place it anew"):
        run.run()
    assert len(list(looks_of(read_survey(tmp_path / "bench")))) == 5


@pytest.mark.long(2, "a whole driven bench; the fit of both is tested quickly on drawn corners")
def test_play_and_harmonics_are_found_where_the_head_has_them(repository: Path, tmp_path: Path) -> None:
    bench = corner_bench(
        repository, one_sided=False, harmonics_rad=((0.0, 0.006), (0.002, 0.0)), backlash_rad=0.004
    )
    run, _ = run_of(bench, tmp_path / "bench", BenchGoal(pointing_px=0.3))
    joints = run.run().rig.joints
    assert joints.pan.backlash_rad == pytest.approx(0.004, abs=4e-4)
    known = Knowledge(run.known.now.rig, {})
    assert pointing(known, Workspace(("navcam_left", "navcam_right"), (-0.5, 0.5), (-0.4, 0.1)))
    read = np.linspace(-0.8, 0.8, 9)
    true = read + 0.006 * np.sin(read) + 0.002 * np.cos(2 * read)
    off = np.asarray(joints.pan.true_rad(read)) - true
    assert np.ptp(off) < 1.5e-3  # an offset is no error of the joint: zero is a choice


def test_a_folder_of_another_board_is_refused(repository: Path, tmp_path: Path) -> None:
    bench = corner_bench(repository)
    run_of(bench, tmp_path / "bench")
    bench.noise_px = 0.11
    with pytest.raises(
        CalibError, match=r"sigma\.corner_px: is 0\.05, now it would be 0\.11; another folder"
    ):
        run_of(bench, tmp_path / "bench")


def test_two_runs_do_not_keep_their_looks_in_one_folder(repository: Path, tmp_path: Path) -> None:
    run, _ = run_of(corner_bench(repository), tmp_path / "bench")
    with pytest.raises(CalibError, match="another run keeps its looks there"):
        run_of(corner_bench(repository), tmp_path / "bench")
    run._kept.let_go()
    run_of(corner_bench(repository), tmp_path / "bench")


@pytest.mark.long(3, "a bench is killed and begun anew, look after look")
def test_a_run_that_is_killed_again_and_again_loses_no_look_and_comes_to_its_end(
    repository: Path, tmp_path: Path
) -> None:
    folder, rng = tmp_path / "bench", np.random.default_rng(7)
    before: list[str] = []
    for kill in range(12):
        command = [
            sys.executable,
            str(Path(__file__).with_name("killed_run.py")),
            str(folder),
            str(repository),
        ]
        world = {**os.environ, "PYTHONPATH": os.pathsep.join([str(repository), str(Path(__file__).parent)])}
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=world)
        assert process.stdout is not None and process.stdout.readline() == "begun\n"
        if kill < 5:
            wanted = len(before) + int(rng.integers(1, 12))
            while process.poll() is None and len(_files(folder)) < wanted:
                time.sleep(0.002)  # bounded by the run's own end
            process.send_signal(signal.SIGKILL)
        rest = process.stdout.read()
        process.wait()
        images = [image.name for image in read_survey(folder).images]  # readable, whatever it died of
        assert images[: len(before)] == before
        before = images
        if rest == "done\n":
            return
    raise AssertionError("twelve starts did not end the run")


def _files(folder: Path) -> list[str]:
    try:
        return (folder / "images.csv").read_text().splitlines()[1:]
    except OSError:
        return []


@pytest.mark.long(2, "a whole driven bench; a slip is named quickly by the fit on drawn corners")
def test_a_head_that_slipped_ends_the_run_with_the_placement_and_names_it(
    repository: Path, tmp_path: Path
) -> None:
    bench = corner_bench(repository, seed=6)
    run, _ = run_of(bench, tmp_path / "bench")
    looked, taken = bench.look, 0

    def look(pan_rad: float, tilt_rad: float, approach: tuple[int, int] = (0, 0)) -> BenchLook:
        nonlocal taken
        taken += 1
        shown = looked(pan_rad + 0.01 * (taken > 6), tilt_rad, approach)
        read = [replace(one, pan_rad=one.pan_rad - 0.01 * (taken > 6)) for one in shown.seen]
        return replace(shown, seen=tuple(read))

    bench.look = look  # type: ignore[method-assign]
    with pytest.raises(
        SomethingChanged,
        match=r"pan slipped by about (9\.9|10\.0|10\.1) mrad between pictures p1-006-.*p1-007-",
    ):
        run.run()
    assert run.known.placements() == ["p1"]
    assert len(run.known.of("p1")) == 9  # six before, two after, and the first one taken again


@pytest.mark.parametrize("untied", [(), ("hazcam_left",)])
def test_the_board_is_asked_for_where_it_ties_body_cameras_only_while_some_are_not_tied(
    monkeypatch: pytest.MonkeyPatch, untied: tuple[str, ...]
) -> None:
    monkeypatch.setattr("mastctl.bench.run.advise_for_body", lambda *known: known[-1])
    known = SimpleNamespace(now=None, sought=None, shots=[], untied=lambda: untied)
    run: Any = SimpleNamespace(known=known)
    assert BenchRun._body_advice(run) == (untied or None)
