"""Pointing with one camera beside the pair: range told, a plane told, nothing told.

    .venv/bin/python -m tools.campaigns.one_eye [--cases 8] [--distances 10,6,2] [--head NAME] [--json]

The packaged rover twice, of one scene: with both Navcams, and with the left one alone. Targets are found by
the pair; each is clicked in both from the same view. Told are rms of the true residual, px an axis, of the
first and second pointing; and how often, in percent, 95 % intervals held: of the residual as measured (each
coordinate), of where the target was predicted (both coordinates together), and of the range as told after the
last picture.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from calib.files.mast_file import parse_rig
from drivers.sim.rover import SimulatedRover
from mastctl.client import Client
from mastctl.config import Config, load_config
from mastctl.daemon import RunningDaemon
from mastctl.devices.frames import camera_and_sequence
from mastctl.experiment.simulated import SimulationTruth, demo_config
from mastctl.experiment.targets import Target, TargetViews, pointed
from tools.command import end, numbers, options, percent, rms, run_cases, show

PAIR = ("navcam_left", "navcam_right")
CASES = ("pair", "range told", "plane told", "unknown")
PAN_RANGE_RAD = 1.2
TRIES = 12
NORMAL_95, CHI2_95_OF_TWO = 1.96, 5.991


@dataclass(frozen=True)
class OneEyeTask:
    """One target at a distance."""

    distance_m: float
    index: int
    head: str
    seed: int


@dataclass
class OneEyeFound:
    """Of one case: true residuals (n, 2) by pointing, which intervals held, what failed."""

    first_px: list[tuple[float, float]] = field(default_factory=list)
    second_px: list[tuple[float, float]] = field(default_factory=list)
    residual_held: list[bool] = field(default_factory=list)
    predicted_held: list[bool] = field(default_factory=list)
    range_held: list[bool] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    def __iadd__(self, other: OneEyeFound) -> OneEyeFound:
        for name, values in vars(other).items():
            getattr(self, name).extend(values)
        return self


def alone(config: Config) -> Config:
    """The same rover with its left Navcam only."""
    cameras = {PAIR[0]: config.hardware.cameras[PAIR[0]]}
    return replace(config, hardware=replace(config.hardware, cameras=cameras))


def point(task: OneEyeTask) -> dict[str, OneEyeFound]:
    """Find one target with the pair and point at it in every case."""
    config = demo_config(load_config(None), head=task.head, seed=task.seed)
    with RunningDaemon(config) as two, Client(two.url) as pair:
        rng = np.random.default_rng([task.seed, round(1000 * task.distance_m), task.index])
        rig = parse_rig(pair.mast_file(), "the mast file").rig
        views = TargetViews(pair, rig, PAIR, pair.status()["limits"], rng, PAN_RANGE_RAD)
        target: Target | None = None
        for _ in range(TRIES):
            target = views.find_target(task.distance_m)
            if target is not None:
                break
        if target is None:
            return {case: OneEyeFound(errors=[f"no target at {task.distance_m:g} m"]) for case in CASES}
        rover = two.hardware.simulation
        assert rover is not None
        found = {CASES[0]: judged(pair, rover, target, {})}
    with RunningDaemon(alone(config)) as one, Client(one.url) as client:
        rover = one.hardware.simulation
        assert rover is not None
        for case in CASES[1:]:
            found[case] = judged(client, rover, target, {"case": case})
    return found


def judged(client: Client, rover: SimulatedRover, target: Target, how: Mapping[str, str]) -> OneEyeFound:
    """Point twice at a target from the view that it was found in, and hold the record against the truth."""
    at = target.shot
    pointed(client, pan_rad=at.pan_rad, tilt_rad=at.tilt_rad)
    shot = client.snapshot(PAIR[0])
    place = rover.true_point(*camera_and_sequence(shot.frame_id), (target.x_px, target.y_px))
    if place is None:
        return OneEyeFound(errors=["the click hit the sky"])
    told: dict[str, Any] = {}
    if how.get("case") == "range told":
        eye = rover.frame_truth(*camera_and_sequence(shot.frame_id)).camera_in_rover
        told["range_m"] = float(np.linalg.norm(place - eye.C))
    elif how.get("case") == "plane told":
        told["plane"] = {"point_m": place.tolist()}
    record = pointed(client, pixel=(PAIR[0], shot.frame_id, target.x_px, target.y_px), pointings=2, **told)
    found = OneEyeFound()
    if record["state"] != "done":
        error = record.get("error") or {}
        found.errors.append(f"{how.get('case', 'pair')}: {error.get('code')}: {error.get('message')}")
    truth = SimulationTruth(rover)
    last = None
    for number, row in enumerate(record["pointings"]):
        aim = (row["aim_px"][0], row["aim_px"][1])
        true = truth.residual_px(shot.frame_id, (target.x_px, target.y_px), row["frame_id"], aim)
        if true is None:
            continue
        (found.first_px if number == 0 else found.second_px).append(true)
        off = np.subtract(row["residual_px"], true) / row["residual_sigma_px"]
        found.residual_held += (np.abs(off) <= NORMAL_95).tolist()
        if row["predicted_covariance_px2"] is not None:
            away = np.add(true, aim) - row["predicted_px"]
            chi2 = float(away @ np.linalg.solve(row["predicted_covariance_px2"], away))
            found.predicted_held.append(chi2 <= CHI2_95_OF_TWO)
        last = row
    if last is not None and record["range_interval_m"] is not None and record["range_from"] in FOUND_OUT:
        eye = rover.frame_truth(*camera_and_sequence(last["frame_id"])).camera_in_rover
        true_m = float(np.linalg.norm(place - eye.C))
        near, far = record["range_interval_m"]
        found.range_held.append(near <= true_m <= (math.inf if far is None else far))
    return found


FOUND_OUT = ("parallax", "unknown")


COLUMNS = {
    "case": "{case}", "targets": "{targets}", "first, rms px": "{first_rms_px:.2f}",
    "second": "{second_rms_px:.2f}", "residual held, %": "{residual_held_percent:.0f}",
    "predicted held, %": "{predicted_held_percent:.0f}", "range held, %": "{range_held_percent:.0f}",
}  # fmt: skip


def main() -> int:
    """Point, and print a table or a document."""
    parser = options(__doc__, 8, "targets a distance", as_json=True)
    parser.add_argument("--distances", type=numbers, default="10,6,2", metavar="M,M", help="(default 10,6,2)")
    parser.add_argument("--head", default="ptu_d46_70", metavar="NAME", help="preset (default ptu_d46_70)")
    args = parser.parse_args()
    tasks = [
        OneEyeTask(at, index, args.head, args.seed) for at in args.distances for index in range(args.cases)
    ]
    results = run_cases(args, "targets", point, tasks, "target {0.index} at {0.distance_m:g} m".format)
    rows = []
    for case in CASES:
        found = OneEyeFound()
        for one in results:
            found += one[case]
        rows.append(
            {
                "case": case,
                "targets": len(found.first_px),
                "first_rms_px": rms(found.first_px),
                "second_rms_px": rms(found.second_px),
                "residual_held_percent": percent(found.residual_held),
                "predicted_held_percent": percent(found.predicted_held),
                "range_held_percent": percent(found.range_held),
                "errors": found.errors,
            }
        )
    show(args, rows, COLUMNS, "errors")
    return 0


if __name__ == "__main__":
    end(main)
