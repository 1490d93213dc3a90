"""How true the residuals are that the daemon tells, of clicks at random pixels of rocks and of ground.

    .venv/bin/python -m tools.campaigns.residuals [--cases 200] [--seed 1] [--day kind worst] [--json]

The packaged rover in scenes drawn anew, through a daemon. A case turns the head to a random view, clicks a
random pixel of the left Navcam that shows a rock (or ground) 2 to 10 m away, and points once. No texture is
asked for and nothing is left out. Truth is the simulator's geometry: the clicked pixel's ray meets the scene,
and the point is projected into the new picture. Told are the cases, those refused, in percent, and how many
of these the other eye cannot see; z, which is the measured minus the true residual over the told sigma, of
both axes together (rms, of x and y, the worst); what is beyond three sigmas, percent of targets; the error in
px; medians of sigma.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import FloatArray
from drivers.sim.rover import RoverModel
from drivers.simulation_clock import MAX
from mastctl.client import Client, ClientError, Snapshot
from mastctl.config import Config, load_config
from mastctl.daemon import RunningDaemon
from mastctl.devices.frames import camera_and_sequence
from mastctl.experiment.simulated import simulated_config
from mastctl.experiment.targets import BORDER_PX
from mastctl.packaged import config_folder
from tools.command import end, options, results_of, rms, show

DAYS = {"kind": "default.yaml", "worst": "worst_day.yaml"}
GROUPS = ("rocks", "ground")
LEFT, RIGHT = "navcam_left", "navcam_right"
NEAR_M, FAR_M = 2.0, 10.0
PAN_RAD = 1.3
EYE_HEIGHT_M = 1.46
STEP_PX = 4
"""Of which pixels the scene is asked whether they show a rock."""
ABOVE_M = 0.005
"""What stands this much over the ground is a rock."""
HIDDEN = 0.01
"""A point is hidden from an eye whose ray ends earlier by more than this part of the way."""
MOMENTS = 8
"""Of an exposure, at which the truth is asked where the head stood."""
WAITED_S = 900.0
"""A busy machine is no reason to count a click as refused."""
A_TASK = 10
VIEWS = 40


@dataclass(frozen=True)
class ClicksTask:
    """So many clicks of one group on a day, in one scene of its own."""

    day: str
    group: str
    seed: int
    number: int
    cases: int


@dataclass(frozen=True)
class TrueClick:
    """One click: the code of its refusal, or the error and the sigma (x, y) in px.

    ``hidden``: whether the other camera cannot see what was clicked; ``refused`` is empty for a residual.
    """

    hidden: bool
    refused: str
    error_px: tuple[float, float] | None = None
    sigma_px: tuple[float, float] | None = None


def config_of(day: str, scene_seed: int) -> Config:
    """The packaged rover with its Navcams on such a day, in a scene of its own."""
    config = simulated_config(load_config(config_folder() / DAYS[day]), head=None, wire=None, speed=MAX)
    simulation = {**config.hardware.simulation, "seed": scene_seed}
    cameras = {name: config.hardware.cameras[name] for name in (LEFT, RIGHT)}
    return replace(config, hardware=replace(config.hardware, simulation=simulation, cameras=cameras))


def click_all(task: ClicksTask) -> list[TrueClick]:
    """Click in random views of a scene of the task's own."""
    scene_seed = int(np.random.default_rng([task.seed, task.number, 1]).integers(1, 2**31))
    rng = np.random.default_rng([task.seed, task.number, GROUPS.index(task.group), 2])
    with (
        RunningDaemon(config_of(task.day, scene_seed)) as daemon,
        Client(daemon.url, timeout_s=120.0) as client,
    ):
        rover = daemon.hardware.simulation
        assert rover is not None
        return [click(client, rover, task.group, rng) for _ in range(task.cases)]


def click(client: Client, rover: RoverModel, group: str, rng: np.random.Generator) -> TrueClick:
    """Click a random pixel of the group in a random view, and hold the residual against the truth."""
    shot, pixel = random_click(client, rover, group, rng)
    seen_by = camera_of(rover, shot, pixel[1])
    point = hit(rover, seen_by, np.array([pixel]))[0]
    truth = rover.frame_truth(*camera_and_sequence(shot.frame_id))
    other = rover.rig.camera_in_rover(RIGHT, truth.pan_rad, truth.tilt_rad)
    hidden = not shown(rover, other, point)
    record: Any
    try:
        record = client.wait(client.point(pixel=(LEFT, shot.frame_id, *pixel)), timeout_s=WAITED_S)
    except ClientError as error:
        return TrueClick(hidden, error.code)
    if record["state"] != "done":
        return TrueClick(hidden, record["error"]["code"] if record["error"] else record["state"])
    (row,) = record["pointings"]
    measured = np.array(row["target_px"])
    landed = client.snapshot(LEFT, frame_id=row["frame_id"])
    true, _ = camera_of(rover, landed, float(measured[1])).project(point)
    error_px, sigma_px = measured - true, row["residual_sigma_px"]
    return TrueClick(hidden, "", error_px=tuple(error_px.tolist()), sigma_px=tuple(sigma_px))


def camera_of(rover: RoverModel, shot: Snapshot, row_px: float) -> CameraModel:
    """The true camera of a picture in the rover frame, the mean over the exposure of one of its rows.

    Of a rolling shutter each row has a time of its own, and the mast may ring.
    """
    truth = rover.frame_truth(*camera_and_sequence(shot.frame_id))
    row_s = (row_px - (truth.camera_in_rover.size_px[1] - 1) / 2) * rover.settings.camera.row_time_s
    parts = ((np.arange(MOMENTS) + 0.5) / MOMENTS - 0.5) * shot.exposure_s
    joints = np.mean([rover.true_joints(truth.mid_exposure_s + row_s + part) for part in parts], axis=0)
    pose, then = (
        rover.rig.mast.rover_from_head(*angles) for angles in (joints, (truth.pan_rad, truth.tilt_rad))
    )
    return truth.camera_in_rover.moved(pose @ then.inverse)


def random_click(
    client: Client, rover: RoverModel, group: str, rng: np.random.Generator
) -> tuple[Snapshot, tuple[float, float]]:
    """A picture of a random view with something of the group in it, and a random pixel of that."""
    model = rover.rig.cameras[LEFT].model
    axes = (np.arange(BORDER_PX, side - BORDER_PX, STEP_PX, dtype=float) for side in model.size_px)
    pixels = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    for _ in range(VIEWS):
        pan = float(rng.uniform(-PAN_RAD, PAN_RAD))
        tilt = -math.atan2(EYE_HEIGHT_M, math.exp(rng.uniform(math.log(NEAR_M), math.log(FAR_M))))
        seen = pixels[of_group(rover, rover.rig.camera_in_rover(LEFT, pan, tilt), pixels, group)]
        if not len(seen):
            continue
        pixel = np.round(seen[rng.integers(len(seen))] + rng.uniform(-0.5, 0.5, 2) * STEP_PX, 1)
        client.wait(client.point(pan_rad=pan, tilt_rad=tilt), timeout_s=WAITED_S)
        shot = client.snapshot(LEFT)
        camera = camera_of(rover, shot, float(pixel[1]))
        if of_group(rover, camera, pixel[None], group)[0]:  # where the head truly stands
            return shot, (float(pixel[0]), float(pixel[1]))
    raise RuntimeError(f"no view of {VIEWS} has {group} {NEAR_M:g} to {FAR_M:g} m away")


def of_group(rover: RoverModel, camera: CameraModel, pixels: FloatArray, group: str) -> NDArray[np.bool_]:
    """Which pixels (n, 2) of a camera in the rover frame show a rock (or ground) in range."""
    points = hit(rover, camera, pixels)
    ranges_m = np.linalg.norm(points - camera.C, axis=1)
    inside = (ranges_m >= NEAR_M) & (ranges_m <= FAR_M)
    points = rover.site_from_rover.points(points[inside])
    ground_z = np.array([rover.scene.ground_z_m(x, y) for x, y in points[:, :2]])
    rock = points[:, 2] < ground_z - ABOVE_M
    inside[inside] = rock if group == "rocks" else ~rock
    return np.asarray(inside)


def hit(rover: RoverModel, camera: CameraModel, pixels: FloatArray) -> FloatArray:
    """Where the rays of a camera's pixels (n, 2) meet the scene, (n, 3) in the rover frame; nan for sky."""
    rays, site = camera.ray(pixels), rover.site_from_rover
    ranges_m = rover.scene.cast(site.points(rays.origins_m), site.vectors(rays.directions))
    return np.asarray(rays.origins_m + ranges_m[:, None] * rays.directions)


def shown(rover: RoverModel, camera: CameraModel, point_m: FloatArray) -> bool:
    """Whether a camera sees a point (3,) of the rover frame: inside, and hidden by nothing nearer."""
    pixel, valid = camera.project(point_m)
    if not (valid and camera.holds(pixel, 0.0)):
        return False
    ray, site = camera.ray(pixel), rover.site_from_rover
    ends_m = float(rover.scene.cast(site.points(ray.origins_m), site.vectors(ray.directions)))
    return ends_m > (1.0 - HIDDEN) * float((point_m - ray.origins_m) @ ray.directions)


def summary(day: str, group: str, clicks: Sequence[TrueClick]) -> dict[str, Any]:
    """A row of the table."""
    refused = [one for one in clicks if one.refused]
    good = [one for one in clicks if not one.refused]
    row: dict[str, Any] = {
        "day": day,
        "group": group,
        "cases": len(clicks),
        "refused_percent": 100.0 * len(refused) / max(len(clicks), 1),
        "refused_hidden": sum(one.hidden for one in refused),
        "reasons": [f"{n} {code}" for code, n in Counter(one.refused for one in refused).most_common()],
    }
    if not good:
        return row
    error = np.array([one.error_px for one in good])
    sigma = np.array([one.sigma_px for one in good])
    z = error / sigma
    return row | {
        "z_rms": rms(z),
        "z_rms_x_y": [rms(z[:, 0]), rms(z[:, 1])],
        "worst_z": float(np.abs(z).max()),
        "beyond_3_percent": 100.0 * float((np.abs(z).max(axis=1) > 3.0).mean()),
        "error_rms_px": [rms(error[:, 0]), rms(error[:, 1])],
        "worst_error_px": float(np.abs(error).max()),
        "median_sigma_px": np.median(sigma, axis=0).tolist(),
    }


_X_Y = "{{{0}[0]:{1}}}, {{{0}[1]:{1}}}".format
COLUMNS = {
    "day": "{day}", "on": "{group}", "cases": "{cases}", "refused, %": "{refused_percent:.0f}",
    "of these hidden": "{refused_hidden}", "z rms": "{z_rms:.2f}", "of x, y": _X_Y("z_rms_x_y", ".2f"),
    "worst": "{worst_z:.1f}", "beyond 3, %": "{beyond_3_percent:.1f}",
    "error rms, px": _X_Y("error_rms_px", ".3f"), "worst px": "{worst_error_px:.2f}",
    "sigma, px": _X_Y("median_sigma_px", ".3f"),
}  # fmt: skip


def main() -> int:
    """Click, and print a table or a document."""
    parser = options(__doc__, 200, "clicks a group and day", as_json=True)
    parser.add_argument("--day", choices=DAYS, nargs="+", default=list(DAYS), help="(default both)")
    args = parser.parse_args()
    tasks = [
        ClicksTask(day, group, args.seed, number, min(A_TASK, args.cases - number * A_TASK))
        for number in range(math.ceil(args.cases / A_TASK))
        for day in args.day
        for group in GROUPS
    ]
    label = "{0.day} day, {0.group}, scene {0.number}".format
    found = results_of(args, "scenes", click_all, tasks, label)
    rows = []
    for day, group in product(args.day, GROUPS):
        mine = [
            one
            for task, row in zip(tasks, found, strict=True)
            if (task.day, task.group) == (day, group)
            for one in row
        ]
        rows.append(summary(day, group, mine))
    show(args, rows, COLUMNS, "reasons")
    return 0


if __name__ == "__main__":
    end(main)
