"""A whole bench on corners: from a drawing to a rig that points, killed on the way, disturbed on the way."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.files.mast_file import load_rig
from calib.geometry.rig import Rig
from calib.plan.knowledge import BenchShot
from calib.plan.placements import Placement
from calib.survey.reader import read_survey
from hil_tests.mastctl.bench.bench_of_corners import CornerBench
from hil_tests.mastctl.bench.bench_world import corner_bench, run_of
from mastctl.bench.mast import BenchInterrupted, BenchLook
from mastctl.bench.survey import looks_of


def test_a_bench_ends_by_itself_with_what_was_wanted_met_on_paper_and_kept(
    repository: Path, tmp_path: Path
) -> None:
    bench = corner_bench(repository)
    run, person = run_of(bench, tmp_path / "bench")
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
    assert any("p2" in line for line in person.sentences)


def whole_rover(repository: Path) -> tuple[Rig, Rig]:
    """Three pairs: two on the head, one of them of a narrow view, and one on the body."""
    true = load_rig(repository / "configs/sim/rocky8.yaml").rig
    believed = load_rig(repository / "configs/masts/rocky8_simulated.yaml").rig
    return replace(true, provenance={}), replace(believed, provenance={}, fit={})


def test_a_camera_that_can_show_nothing_new_takes_no_picture(repository: Path, tmp_path: Path) -> None:
    bench = corner_bench(repository, of=whole_rover)
    run, _ = run_of(bench, tmp_path / "bench")
    known, every = run.known, tuple(bench.head.rig.cameras)
    bench.stand(Placement(1.3, 0.0, -35.0, (10.0, 0.0)))
    known.take("p1", bench.look(0.0, -0.6))
    for _ in range(3):
        look = run.look_at(BenchShot("p1", 0.0, -0.6, ()))
        assert look is not None and set(look.cameras) == set(every)
        known.take("p1", look)
    assert not {"hazcam_left", "hazcam_right"} & set(known.cameras_for("p1")), "it stands still before them"
    for shot in known.round_others("p1"):
        look = run.look_at(shot)
        assert look is not None
        known.take("p1", look)
    for pancam in ("pancam_left", "pancam_right"):
        tilts = [look.tilt_rad for look in known.of("p1") if pancam in {one.camera for one in look.found}]
        assert len(tilts) >= 4 and np.ptp(tilts) > np.radians(11.0), "what a fit of its place needs"
    assert not list(known.round_others("p1"))


class Dying(RuntimeError):
    """Stands for a kill between two looks."""


class Mortal:
    """A mast that dies after some looks."""

    def __init__(self, bench: CornerBench, looks: int) -> None:
        self.bench, self.left, self.head = bench, looks, bench.head

    def look(self, *at: Any) -> BenchLook:
        if not self.left:
            raise Dying
        self.left -= 1
        return self.bench.look(*at)


def test_a_run_that_died_goes_on_at_its_placement_without_a_request(repository: Path, tmp_path: Path) -> None:
    bench = corner_bench(repository, seed=2)
    run, _ = run_of(bench, tmp_path / "bench", mast=Mortal(bench, 5))  # dies in the first placement
    with pytest.raises(Dying):
        run.run()
    before = list(looks_of(read_survey(tmp_path / "bench")))
    again, second = run_of(bench, tmp_path / "bench", mast=Mortal(bench, 3))  # its end is that of any run
    with pytest.raises(Dying):
        again.run()
    after = list(looks_of(read_survey(tmp_path / "bench")))
    assert len(before) == 5 and [p for p, _, _ in after][:5] == [p for p, _, _ in before]
    assert len(after) > 5 and after[5][0] == before[4][0], "it goes on at the same placement"
    assert any("stands as it stood" in line for line in second.sentences)
    assert not any(line.startswith("p1: straight ahead") for line in second.sentences)
    assert second.shown[0]["placements"] == 1 and second.shown[0]["pictures"] == len(before)


def test_a_board_that_is_taken_away_ends_the_run_and_loses_nothing(repository: Path, tmp_path: Path) -> None:
    bench = corner_bench(repository)
    run, _ = run_of(bench, tmp_path / "bench")
    looked = bench.look
    taken = 0

    def look(*at: Any) -> BenchLook:
        nonlocal taken
        taken += 1
        if taken == 6:
            bench.rover_from_board = None
        return looked(*at)

    bench.look = look  # type: ignore[assignment, method-assign]
    with pytest.raises(BenchInterrupted, match="Put it back or place it anew"):
        run.run()
    assert len(list(looks_of(read_survey(tmp_path / "bench")))) == 5
