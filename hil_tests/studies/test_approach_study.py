"""The approach experiment's own arithmetic; the runs themselves are a command."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.files.mast_file import load_rig
from calib.geometry.pointing import solve
from calib.geometry.rig import Rig
from drivers.sim import rocks
from drivers.sim.scene import Scene, SceneSettings, make_grid, tiny_scene
from mastctl.experiment.tasks import KeptResults
from tools.studies import approach_run as approach
from tools.studies.approach import (
    approach_table,
    handoffs,
    losses,
    main,
    strip,
    summary,
    write_record,
    write_strip,
)
from tools.studies.approach_run import ROCK_M, ROCKS, START_M, ApproachRun, Stop
from tools.studies.approach_world import WINDOW_PX, ApproachWorld, WorldErrors, windowed


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
        ApproachRun(2, (replace(stop(1.05, (-0.004, 0.002, 0.0)), pose_doubt="9 cm"),)),
        ApproachRun(3, (stop(4.0, (0.0, 0.0, 0.0), "lost"),)),
        ApproachRun(4, (), "no view offered a target"),
        ApproachRun(5, (stop(1.05, (0.5, 0.0, 0.0)),)),
    ]
    found = summary(runs)
    assert (found["runs"], found["kept"], found["silently_wrong"]) == (5, 3, 1)
    assert (found["poses_doubted"], found["stops"]) == (1, 5)
    assert math.isclose(found["final_right_rms_m"], math.sqrt(0.002**2 / 3))
    assert math.isclose(found["untracked_along_rms_m"], 0.1)
    assert (found["losses"], found["recoveries"], found["handoffs"]) == (1, 0, 0)
    assert [found[f"stops_from_{low}_m"] for low in (6, 2, 0)] == [0, 1, 3]
    headings, rows = approach_table(runs)
    assert headings[1:3] == ("eqs. (1)-(4)", "paper")
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


# Targets on rocks: on level ground, z = 0, where the height of a point is plain


@pytest.fixture(scope="module")
def rig(repository: Path) -> Rig:
    pytest.importorskip("numba", reason="the simulated rover needs numba (extra sim)")
    return load_rig(repository / "configs/sim/rocky8.yaml").rig


@pytest.fixture
def standing(rig: Rig) -> Iterator[Callable[..., ApproachWorld]]:
    """Make worlds of level ground with these parts exchanged; the rover stands at its middle."""
    made: list[ApproachWorld] = []

    def world(seed: int = 1, **parts: Any) -> ApproachWorld:
        scene = tiny_scene()
        scene = Scene(scene.settings, scene.world._replace(**parts))
        made.append(ApproachWorld(scene, rig, rig, WorldErrors(), np.random.default_rng(seed)))
        return made[-1]

    yield world
    for one in made:
        one.close()


@pytest.mark.parametrize("range_m", [6.0, 10.0])
def test_the_rover_turns_to_a_rock_at_the_range_that_stands_out_of_the_ground(
    standing: Callable[..., ApproachWorld], range_m: float
) -> None:
    stones = rocks.make_rocks(60, np.random.default_rng(5), lambda x, y: 0.0)
    world = standing(rocks=stones)
    mast = world.true.mast.translation_m
    chosen = set()
    for _ in range(10):
        before = world.site_from_rover
        point = world.turn_to_rock(range_m, ROCK_M)
        assert point is not None
        assert -0.6 < point[2] <= -ROCK_M, "above the ground, and no higher than a stone"
        away_m = float(np.linalg.norm(point - before.points(mast)))
        assert abs(away_m - range_m) <= 0.15 * range_m
        (stone,) = np.nonzero(
            np.linalg.norm(stones.spheres_m[:, :3] - point, axis=1) <= stones.spheres_m[:, 3]
        )
        chosen.update(stone.tolist())
        there = world.site_from_rover
        assert there.translation_m == pytest.approx([0.0, 0.0, 0.0])
        ahead = there.inverse.points(point)
        assert abs(math.atan2(ahead[1], ahead[0])) < 0.45, "ahead, but not always straight ahead"
    assert len(chosen) > 1, "not always the same stone"


def test_without_a_rock_at_the_range_nothing_turns_and_the_run_says_so(
    standing: Callable[..., ApproachWorld], rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A brick 8.2 m away, which some rays meet that would reach the ground 8.5 m away."""
    brick = rocks.make_brick(rig.mast.translation_m[0] + 8.1, 0.0, math.pi / 2, lambda x, y: 0.0)
    world = standing(rocks=rocks.meshes([brick]))
    before = world.site_from_rover
    assert world.turn_to_rock(START_M, ROCK_M) is None
    assert world.turn_to_rock(8.0, 0.18) is None, "it stands 17 cm out of the ground"
    assert world.site_from_rover == before
    assert world.turn_to_rock(8.0, ROCK_M) is not None
    asked: list[SceneSettings] = []

    def build(settings: SceneSettings) -> Scene:
        asked.append(settings)
        return Scene(settings, tiny_scene().world._replace(rocks=rocks.meshes([brick])))

    monkeypatch.setattr(approach, "build_scene", build)
    assert approach.run_approach(rig, rig, 3).error == "no rock stands at the start range"
    assert asked == [SceneSettings(seed=3, rocks=ROCKS)]


def test_on_ground_the_rover_looks_at_level_ground_ahead(standing: Callable[..., ApproachWorld]) -> None:
    world = standing()
    before = world.site_from_rover
    for _ in range(5):
        aim = approach._aim(world, np.random.default_rng(2), "ground")
        assert aim is not None
        assert float(np.hypot(aim[0], aim[1])) == pytest.approx(START_M)
        assert aim[2] == 0.0 and aim[0] > 0.8 * START_M
    assert world.site_from_rover == before


def test_height_is_above_the_ground_under_a_point(standing: Callable[..., ApproachWorld]) -> None:
    raised = make_grid(np.full((9, 9), 0.25, dtype=np.float32), 8.0)
    assert standing().height_m(np.array([3.0, 1.0, -0.1])) == pytest.approx(0.1)
    assert standing(inner=raised).height_m(np.array([3.0, 1.0, -0.1])) == pytest.approx(-0.15)


def test_a_target_is_on_a_rock_and_not_at_its_boundary(standing: Callable[..., ApproachWorld]) -> None:
    """The front of a brick 10 m ahead, 39 cm across and 17 cm out of the ground."""
    brick = rocks.make_brick(START_M, 0.0, math.pi / 2, lambda x, y: 0.0)
    world = standing(rocks=rocks.meshes([brick]))
    front = START_M - rocks.BRICK_SIZE_M[1] / 2
    camera = "pancam_left"
    angles = solve(
        world.true.mast,
        world.true.cameras[camera].model,
        world.site_from_rover.inverse.points([front, 0.0, -0.08]),
    )[0]

    def on_rock(y_m: float, z_m: float, x_m: float = front) -> bool:
        target = np.array([x_m, y_m, z_m])
        pixel = world.true_pixel(camera, angles.pan_rad, angles.tilt_rad, target)
        return approach._on_rock(world, camera, angles.pan_rad, angles.tilt_rad, pixel, target)

    assert on_rock(0.0, -0.08) and on_rock(0.13, -0.10)
    assert not on_rock(0.18, -0.08), "2 cm from the side"
    assert not on_rock(0.0, -0.17, START_M + 0.08), "at the far edge of the top"
    assert not on_rock(0.0, -0.04), "so low that it may be the ground"
    assert not on_rock(0.0, 0.0, START_M - 1.0), "on the ground before it"


@pytest.mark.parametrize(("words", "on"), [([], "rocks"), (["--on", "ground"], "ground")])
def test_the_command_says_what_targets_lie_on(
    words: list[str],
    on: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("tools.studies.approach.write_strip", lambda run, folder: None)
    command = ["--cases", "2", "--results", str(tmp_path), *words]
    with pytest.raises(SystemExit, match=r"^0$"):
        main([*command, "--list-tasks", "--json"])
    for row in json.loads(capsys.readouterr().out)["tasks"]:
        assert row["task"].startswith(f"on {on}, seed ")
        run = ApproachRun(int(row["task"].split()[-1]), (stop(1.05, (0.001, 0.0, 0.0)),))
        KeptResults(tmp_path).write(row["id"], row["task"], run)
    assert main([*command, "--out", str(tmp_path / "out")]) == 0
    assert f"targets on {on}" in capsys.readouterr().out
    record = json.loads((tmp_path / "out" / "record.json").read_text())
    assert [run["seed"] for run in record["runs"]] == [1, 2]
    with pytest.raises(SystemExit, match=r"^2$"):
        main(["--on", "sand"])


def test_a_task_is_the_approach_of_its_seed(monkeypatch: pytest.MonkeyPatch, repository: Path) -> None:
    asked = []

    def run(*rigs: Rig, **more: Any) -> ApproachRun:
        asked.append((*rigs, more))
        return ApproachRun(7, ())

    monkeypatch.setattr(approach, "run_approach", lambda a, b, seed, **more: run(a, b, seed=seed, **more))
    rig = load_rig(repository / "configs/sim/rocky8.yaml").rig
    assert approach.one_approach(approach.ApproachTask(rig, rig, 7, "ground")).seed == 7
    assert asked == [(rig, rig, {"seed": 7, "on": "ground"})]
