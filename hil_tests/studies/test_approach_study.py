"""The approach experiment's own arithmetic; the runs themselves are a command."""

from __future__ import annotations

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
from drivers.sim.placed import SceneSettings
from drivers.sim.scene import Scene
from hil_tests.drivers.sim.small_scenes import build_small_scene
from tools.studies import approach
from tools.studies.approach import ROCK_M, START_M, ApproachRun, Stop, approach_rows
from tools.studies.approach_world import ApproachWorld, WorldErrors


def stop(range_m: float, error_m: tuple[float, float, float], state: str = "tracked") -> Stop:
    return Stop(range_m, "hazcam", state, error_m, (0.003,) * 3, (0.1, 0.0, 0.0))


def test_runs_are_counted_and_averaged_by_hand() -> None:
    runs = [
        ApproachRun(1, (stop(5.0, (0.02, 0.0, 0.0)), stop(1.05, (0.003, 0.0, 0.001)))),
        ApproachRun(2, (replace(stop(1.05, (-0.004, 0.002, 0.0)), doubted=True),)),
        ApproachRun(3, (stop(4.0, (0.0, 0.0, 0.0), "lost"),)),
        ApproachRun(4, (), "no view offered a target"),
        ApproachRun(5, (stop(1.05, (0.5, 0.0, 0.0)),)),
    ]
    rows = approach_rows(runs)
    counts = rows[-1]["counts"]
    assert (counts["runs"], counts["kept"], counts["silently wrong"]) == (5, 3, 1)
    assert (counts["honest poses doubted"], counts["stops"]) == (1, 5)
    assert (counts["losses"], counts["found again"], counts["hand-offs"]) == (1, 0, 0)
    assert [row["stops"] for row in rows[3:]] == [0, 1, 3]
    assert "along_cm" not in rows[3]
    assert math.isclose(rows[2]["right_cm"], 300 * math.sqrt(0.002**2 / 3))
    assert math.isclose(rows[1]["along_cm"], 30)
    budget = [(row["theory_cm"], row["paper_cm"]) for row in rows[:3]]
    assert budget == [(pytest.approx(paper, abs=0.06), paper) for paper in (9.7, 22.2, 1.5)]


# Targets on rocks: on level ground, z = 0, where the height of a point is plain


@pytest.fixture(scope="module")
def rig(repository: Path) -> Rig:
    pytest.importorskip("numba", reason="the simulated rover needs numba (extra sim)")
    return load_rig(repository / "configs/sim/rocky8.yaml").rig


@pytest.fixture(scope="module")
def level() -> Scene:
    return build_small_scene(SceneSettings(relief_m=0.0, rocks=1))


@pytest.fixture
def standing(rig: Rig, level: Scene) -> Iterator[Callable[..., ApproachWorld]]:
    """Make worlds of level ground with these parts exchanged; the rover stands at its middle."""
    made: list[ApproachWorld] = []

    def world(seed: int = 1, **parts: Any) -> ApproachWorld:
        scene = Scene(level.settings, level.world._replace(**parts))
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
        return approach.lies_on_rock(world, camera, angles.pan_rad, angles.tilt_rad, pixel, target)

    assert on_rock(0.0, -0.08) and on_rock(0.13, -0.10)
    assert not on_rock(0.18, -0.08), "2 cm from the side"
    assert not on_rock(0.0, -0.17, START_M + 0.08), "at the far edge of the top"
    assert not on_rock(0.0, -0.04), "so low that it may be the ground"
    assert not on_rock(0.0, 0.0, START_M - 1.0), "on the ground before it"
