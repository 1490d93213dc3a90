"""The paper's approach (Fig. 1, Table I) on the simulated rover: a target picked at 10 m, followed to 1 m.

    .venv/bin/python -m tools.studies.approach --cases 5

Each run follows a rock from Pancam to Navcam to Hazcam, a minute a run. It prints the errors of the tracked
stops beside the paper's Table I.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibError
from calib.files.mast_file import load_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.pointing import solve
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.geometry.stereo import target_approach_budget
from calib.matching.search import seen_by
from calib.matching.track import Track, moved_track, start_track
from drivers.sim.placed import SceneSettings
from drivers.sim.scene import build_scene
from mastctl.experiment.targets import texture_mask
from mastctl.motion.pairs import choose_pairs
from mastctl.packaged import config_folder
from tools.command import end, options, results_of, show
from tools.studies.approach_world import ApproachWorld, WorldErrors

START_M, END_M = 10.0, 1.0
STEP = 0.1
"""Of the range, driven in one step."""

ROCK_M = 0.05
"""A target so far above the ground is on a rock."""

ROCKS = 150
"""In the scene, so that several stand at the start range."""

PICKS = 12
"""Pixels that are tried in one view: most of a rock's strongest texture is its edge, which is refused."""

INSIDE_PX, APART_M = 15.0, 0.15
"""On a rock, what is seen this far beside a target (4 cm across at 10 m) is not farther away from it."""

NEAR_ROCK_PX = 40
"""How far from the rock's chosen point its texture is looked for."""

SUN_MOVES_RAD = math.radians(8.0)
LOST_LOOKS = 3
"""How often a lost target is looked for at one stop, before the rover drives on."""

GIVE_UP = 4
"""Stops without the target after which the run ends as lost."""


AXES = ("along", "right", "below")
"""Of an error: along the pair's line of sight, to its right, below it."""


@dataclass(frozen=True)
class Stop:
    """One stop of an approach; errors are believed less true, along `AXES`.

    ``range_m`` is the true distance from the middle of the pair's cameras; ``state`` tracked or lost;
    ``untracked_m`` the error had the start's position been carried by reported motions alone; ``doubted``
    whether the pictures object to the reported motion, which is honest.
    """

    range_m: float
    pair: str
    state: str
    error_m: tuple[float, ...]
    sigma_m: tuple[float, ...]
    untracked_m: tuple[float, ...]
    doubted: bool = False

    @property
    def silently_wrong(self) -> bool:
        """Whether it says tracked and is off by over 3 cm, 1 % of the range and five of its sigmas."""
        far = float(np.linalg.norm(self.error_m)) > max(0.03, 0.01 * self.range_m)
        return (
            self.state == "tracked"
            and far
            and bool((np.abs(self.error_m) > 5 * np.array(self.sigma_m)).any())
        )


@dataclass(frozen=True)
class ApproachRun:
    """One approach: its stops, or why it did not begin; ``start_m`` is the first stereo's error."""

    seed: int
    stops: tuple[Stop, ...]
    error: str = ""
    start_m: tuple[float, ...] = (math.nan,) * 3

    @property
    def kept(self) -> bool:
        """Whether the target was tracked at the last stop, near its end."""
        return bool(self.stops) and self.stops[-1].state == "tracked" and self.stops[-1].range_m < 1.3

    @property
    def handoffs(self) -> int:
        """How often another pair took over and found the target."""
        seen = [stop.pair for stop in self.stops if stop.state == "tracked"]
        return sum(a != b for a, b in pairwise(seen))

    @property
    def losses(self) -> tuple[int, int]:
        """How often the target was lost, and how often found again."""
        pairs = list(pairwise(["tracked", *(stop.state for stop in self.stops)]))
        return pairs.count(("tracked", "lost")), pairs.count(("lost", "tracked"))


@dataclass(frozen=True, eq=False)
class ApproachTask:
    """One approach: the true and the believed rig, and the seed."""

    true: Rig
    believed: Rig
    seed: int


def one_approach(task: ApproachTask) -> ApproachRun:
    """Drive the approach of a task, which comes to the same wherever it runs."""
    return run_approach(task.true, task.believed, task.seed)


def run_approach(true: Rig, believed: Rig, seed: int) -> ApproachRun:
    """Drive one approach to a random rock; ``true`` takes the pictures, ``believed`` is the mast file's."""
    rng = np.random.default_rng([seed, 6])
    light = SceneSettings(seed=seed, rocks=ROCKS)
    world = ApproachWorld(build_scene(light), true, believed, WorldErrors(), rng)
    try:
        begun = _begin(world, rng)
        if isinstance(begun, str):
            return ApproachRun(seed, (), begun)
        track, target = begun
        there = world.site_from_rover.inverse.points(target)
        start_m = _axes(there - track.key.view.camera.C) @ (track.position_m - there)
        world.read_windows()
        stops = _drive(world, track, target, light, rng)
        return ApproachRun(seed, tuple(stops), "", _tuple(start_m))
    finally:
        world.close()


def _begin(world: ApproachWorld, rng: np.random.Generator) -> tuple[Track, FloatArray] | str:
    """Pick a textured pixel of the left Pancam at the start range; the track, and the truth in the site."""
    pair = world.believed.stereo["pancam"]
    reason = "no view offered a target"
    for _ in range(12):
        rock = world.turn_to_rock(START_M, ROCK_M)
        if rock is None:
            return "no rock stands at the start range"
        aim = world.site_from_rover.inverse.points(rock)
        angles = solve(world.believed.mast, world.believed.cameras[pair[0]].model, aim)[0]
        eyes = world.look(pair, angles.pan_rad, angles.tilt_rad)
        left, right = (eyes[name] for name in pair)
        fit = texture_mask(left.image.astype(np.uint8)) & _pixels_near(left.camera, aim)
        rows, columns = np.nonzero(fit)
        for pick in rng.integers(len(rows), size=PICKS) if len(rows) else ():
            pixel = np.array([float(columns[pick]), float(rows[pick])])
            at = (pair[0], angles.pan_rad, angles.tilt_rad, pixel)
            target = world.point_at(*at)
            if target is None or not lies_on_rock(world, *at, target):
                continue
            range_m = float(np.linalg.norm(world.site_from_rover.inverse.points(target) - left.camera.C))
            if abs(range_m - START_M) > 0.15 * START_M:
                continue
            try:
                return start_track(left, right, pixel), target
            except CalibError as error:
                reason = str(error)
    return reason


def _pixels_near(camera: CameraModel, aim_m: FloatArray) -> NDArray[np.bool_]:
    """Which pixels (h, w) lie near the image of a point."""
    (x, y), (width, height) = camera.project(aim_m)[0], camera.size_px
    columns, rows = np.arange(width), np.arange(height)[:, None]
    return np.asarray(np.maximum(np.abs(columns - x), np.abs(rows - y)) <= NEAR_ROCK_PX)


def lies_on_rock(
    world: ApproachWorld, camera: str, pan_rad: float, tilt_rad: float, pixel: FloatArray, target: FloatArray
) -> bool:
    """Whether a target lies on a rock and not at its boundary, where nobody would put one."""
    if world.height_m(target) < ROCK_M:
        return False
    for off in INSIDE_PX * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]):
        beside = world.point_at(camera, pan_rad, tilt_rad, pixel + off)
        if beside is None or float(np.linalg.norm(beside - target)) > APART_M:
            return False
    return True


def _drive(
    world: ApproachWorld, track: Track, target: FloatArray, light: SceneSettings, rng: np.random.Generator
) -> list[Stop]:
    """Step by step up to the target."""
    stops: list[Stop] = []
    missed, relit, carried = 0, False, track.position_m
    for _ in range(60):
        here = world.site_from_rover
        away = target[:2] - here.translation_m[:2]
        distance = float(np.linalg.norm(away))
        # Where the front cameras stand, ahead of the rover's origin, is where 1 m counts from.
        ahead = _front_m(world)
        left_m = distance - ahead
        if left_m <= END_M * 1.02 or missed >= GIVE_UP:
            break
        step = min(STEP * left_m, left_m - END_M)
        bearing = math.atan2(away[1], away[0]) + rng.normal(0.0, 0.15)
        x, y = here.translation_m[:2] + step * np.array([math.cos(bearing), math.sin(bearing)])
        facing = math.atan2(target[1] - y, target[0] - x) + rng.normal(0.0, 0.08)
        motion, covariance = world.drive(float(x), float(y), facing)
        track, carried = moved_track(track, motion, covariance), motion.points(carried)
        if not relit and left_m < 4.0:
            sun = light.sun_azimuth_rad + SUN_MOVES_RAD
            world.relight(build_scene(light.model_copy(update={"sun_azimuth_rad": sun})))
            relit = True
        track, stop = _look(world, track, target, carried)
        stops.append(stop)
        missed = 0 if stop.state == "tracked" else missed + 1
    return stops


def _front_m(world: ApproachWorld) -> float:
    """How far ahead of the rover's origin the last pair stands."""
    left, right = (world.believed.cameras[n].model.C[0] for n in world.believed.stereo["hazcam"])
    return float(left + right) / 2


def _look(
    world: ApproachWorld, track: Track, target: FloatArray, carried_m: FloatArray
) -> tuple[Track, Stop]:
    """Look for the target with the pair of its range, again if it is lost; the track and the record."""
    rig = world.believed
    chosen = choose_pairs(rig, track.position_m)[0]
    name, pan, tilt = chosen.pair, *(chosen.true_rad or (0.0, 0.0))
    pair = rig.stereo[name]
    doubted = False
    for _ in range(LOST_LOOKS):
        eyes = world.look(pair, pan, tilt)
        look = seen_by(track, eyes)
        doubted |= bool(look.doubt)
        if look.track.state == "tracked":
            break
    track = look.track
    true = world.site_from_rover.inverse.points(target)
    middle = (eyes[pair[0]].camera.C + eyes[pair[1]].camera.C) / 2
    axes = _axes(true - middle)
    return track, Stop(
        float(np.linalg.norm(true - middle)),
        name,
        track.state,
        _tuple(axes @ (track.position_m - true)),
        _tuple(np.sqrt(np.diag(axes @ track.target_covariance_m2 @ axes.T))),
        _tuple(axes @ (carried_m - true)),
        doubted,
    )


def _axes(sight: FloatArray) -> FloatArray:
    """Rows: along a line of sight, to its right, below it."""
    along = sight / np.linalg.norm(sight)
    right = np.cross([0.0, 0.0, 1.0], along)
    right /= np.linalg.norm(right)
    return np.stack([along, right, np.cross(along, right)])


def _tuple(values: FloatArray) -> tuple[float, ...]:
    return tuple(values.tolist())


# What the runs come to

PAPER_CM = {"stereo": 9.7, "untracked": 22.2, "tracked": 1.5}
"""Table I as printed, Pancam: stereo at 10 m, the approach without and with ideal tracking; 3 sigma."""

BINS_M = ((6.0, math.inf), (2.0, 6.0), (0.0, 2.0))
COLUMNS = {
    "3 rms, cm": "{name}", "stops": "{stops}", "eqs. (1)-(4)": "{theory_cm:.2f}", "paper": "{paper_cm:g}",
    "range": "{along_cm:.2f}", "right": "{right_cm:.2f}", "below": "{below_cm:.2f}",
    "3-D": "{position_cm:.2f}",
}  # fmt: skip


def approach_rows(runs: Sequence[ApproachRun]) -> list[dict[str, Any]]:
    """Return Table I's three columns as rows: by its equations, as printed, and as measured; then by range.

    Errors are three times the rms, in centimetres, in the rover frame; under the last row, how the runs went.
    """
    kept = [run for run in runs if run.kept]
    began = [run for run in runs if run.stops]
    theory = next(row for row in target_approach_budget() if row.name == "pancam")
    rows = [
        _row("stereo at the start", [r.start_m for r in began], theory.stereo_cm, PAPER_CM["stereo"]),
        _row(
            "at 1 m, not tracked",
            [r.stops[-1].untracked_m for r in kept],
            theory.untracked_cm,
            PAPER_CM["untracked"],
        ),
        _row("at 1 m, tracked", [r.stops[-1].error_m for r in kept], theory.tracked_cm, PAPER_CM["tracked"]),
    ]
    for low, high in BINS_M:
        far = f"{low:g} to {high:g} m" if math.isfinite(high) else f"beyond {low:g} m"
        stops = [s for r in began for s in r.stops if low <= s.range_m < high and s.state == "tracked"]
        rows.append(_row(f"tracked, {far}", [stop.error_m for stop in stops]))
    counts = {
        "runs": len(runs),
        "kept": len(kept),
        "silently wrong": sum(any(stop.silently_wrong for stop in run.stops) for run in runs),
        "hand-offs": sum(run.handoffs for run in began),
        "losses": sum(run.losses[0] for run in began),
        "found again": sum(run.losses[1] for run in began),
        "honest poses doubted": sum(stop.doubted for run in began for stop in run.stops),
        "stops": sum(len(run.stops) for run in began),
    }
    rows[-1] |= {"counts": counts, "notes": [", ".join(f"{name} {n}" for name, n in counts.items())]}
    return rows


def _row(
    name: str,
    errors_m: Sequence[Sequence[float]],
    theory_cm: float | None = None,
    paper_cm: float | None = None,
) -> dict[str, Any]:
    """A row of the table of errors (n, 3), metres; without errors it has no numbers."""
    row = {"name": name, "stops": len(errors_m), "theory_cm": theory_cm, "paper_cm": paper_cm}
    if not errors_m:
        return row
    rms = 300 * np.sqrt(np.mean(np.array(errors_m) ** 2, axis=0))
    parts = {f"{axis}_cm": float(one) for axis, one in zip(AXES, rms, strict=True)}
    return row | parts | {"position_cm": float(np.linalg.norm(rms))}


def main(words: Sequence[str] | None = None) -> int:
    """Run the approaches; 1 if no target at all was kept."""
    parser = options(__doc__, 5, "approaches", as_json=True)
    args = parser.parse_args(words)
    true = load_rig(config_folder() / "sim" / "rocky8.yaml").rig
    believed = load_rig(config_folder() / "masts" / "rocky8_simulated.yaml").rig
    tasks = [ApproachTask(true, believed, args.seed + index) for index in range(args.cases)]
    runs = results_of(
        args, "approaches", one_approach, tasks, "seed {0.seed}".format,
        failure=lambda run: run.error,
    )  # fmt: skip
    show(args, approach_rows(runs), COLUMNS, "notes")
    return 0 if any(one.kept for one in runs) else 1


if __name__ == "__main__":
    end(main)
