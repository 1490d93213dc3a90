"""Pictures older than their stamps: a pointing is refused, or what it tells is true of the head at rest.

    .venv/bin/python -m tools.campaigns.late_pictures [--cases 12] [--repeat-after 1.0] [--json]

The packaged rover, its targets at 2 to 8 m, each pointed at twice, by a head as fast as it may and a slow
one. Its cameras are honest; or every picture is so many seconds older than its stamp, in both eyes; or each
camera delivers, with a new stamp, the picture that it was asked for before. A told residual is compared with
where the target lies for the true joints once the head has settled, and is false if it is off by more than
three of its sigmas. Seconds are of the rover's clock, from the request to the end of one that is done.
"""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np

from calib.files.mast_file import parse_rig
from calib.geometry.rigid import FloatArray
from drivers.interfaces import Frame
from drivers.sim.cameras import SimulatedCamera
from drivers.sim.rover import SimulatedRover
from mastctl.client import Client
from mastctl.config import Config, load_config
from mastctl.daemon import RunningDaemon
from mastctl.devices.frames import camera_and_sequence
from mastctl.experiment.simulated import demo_config
from mastctl.experiment.targets import Target, TargetViews, pointed
from tools.command import end, numbers, options, run_cases, show

PAIR = ("navcam_left", "navcam_right")
PAN_RANGE_RAD = 1.2
TRIES = 12
ASIDE_RAD = 0.25
"""Before a click the head comes from the side, further than any picture of before could be mistaken for."""
FALSE_SIGMAS = 3.0
BUFFERED = -1.0
"""Stands for a lag: the picture of the request before."""


@dataclass(frozen=True)
class LateTask:
    """One target: by number and distance; the speeds, and the lags that are tried at each."""

    index: int
    distance_m: float
    speeds_rad_per_s: tuple[float, ...]
    lags_s: tuple[float, ...]
    repeat_after_s: float
    head: str
    seed: int


@dataclass
class LateFound:
    """Of one speed and lag: how operations ended, each told residual's error over its sigma (the larger axis)
    and in pixels, and how long those that were done took."""

    ended: Counter[str] = field(default_factory=Counter)
    off_sigma: list[float] = field(default_factory=list)
    off_px: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def __iadd__(self, other: LateFound) -> LateFound:
        self.ended.update(other.ended)
        for name in ("off_sigma", "off_px", "seconds"):
            getattr(self, name).extend(getattr(other, name))
        return self


Key = tuple[float, float]


def lagging(config: Config, task: LateTask, speed_rad_per_s: float, lag_s: float) -> Config:
    """The rover with cameras that stamp so late, a cap of speed, and what is asked of a second picture."""
    clocks = {} if lag_s == BUFFERED else {name: {"stamped_late_s": lag_s} for name in PAIR}
    hardware = replace(config.hardware, simulation={**config.hardware.simulation, "clocks": clocks})
    limits = replace(config.limits, speed_rad_per_s=speed_rad_per_s)
    return replace(config, hardware=hardware, limits=limits, repeat_after_s=task.repeat_after_s)


@contextmanager
def buffered() -> Iterator[None]:
    """Every camera delivers the picture that it was asked for before, with the stamp of now."""
    plain = SimulatedCamera.next_frame
    held: dict[SimulatedCamera, Any] = {}

    def next_frame(camera: SimulatedCamera, exposed_after_s: float, timeout_s: float) -> Frame:
        frame = plain(camera, exposed_after_s, timeout_s)
        shown = held.get(camera, frame.image)
        held[camera] = frame.image if camera in held else plain(camera, frame.mid_exposure_s, timeout_s).image
        return Frame(shown, frame.sequence, frame.mid_exposure_s, frame.exposure_s)

    SimulatedCamera.next_frame = next_frame  # type: ignore[method-assign]
    try:
        yield
    finally:
        SimulatedCamera.next_frame = plain  # type: ignore[method-assign]


def point(task: LateTask) -> dict[Key, LateFound]:
    """Find a target with honest cameras, and point at it at every speed with every lag."""
    config = demo_config(load_config(None), head=task.head, seed=task.seed)
    with RunningDaemon(config) as daemon, Client(daemon.url) as client:
        rng = np.random.default_rng([task.seed, task.index])
        rig = parse_rig(client.mast_file(), "the mast file").rig
        views = TargetViews(client, rig, PAIR, client.status()["limits"], rng, PAN_RANGE_RAD)
        target = next(filter(None, (views.find_target(task.distance_m) for _ in range(TRIES))), None)
    found: dict[Key, LateFound] = {}
    for speed, lag_s in product(task.speeds_rad_per_s, task.lags_s) if target is not None else ():
        assert target is not None
        with (
            buffered() if lag_s == BUFFERED else nullcontext(),
            RunningDaemon(lagging(config, task, speed, lag_s)) as daemon,
        ):
            found[speed, lag_s] = judged(daemon, target, lag_s)
    return found


def judged(daemon: RunningDaemon, target: Target, lag_s: float) -> LateFound:
    """Point twice at what a view showed, and hold what is told against the joints of the head at rest."""
    rover, at, pixel_px = daemon.hardware.simulation, target.shot, (target.x_px, target.y_px)
    assert rover is not None
    found = LateFound()
    with Client(daemon.url) as client:
        if lag_s > 0.0:
            for camera in PAIR:  # a stamp is never of the future: what is stamped late comes late
                client.set_fault(camera, "delayed", delay_s=lag_s)
        for aside_rad in (ASIDE_RAD, 0.0):
            pointed(client, pan_rad=at.pan_rad - aside_rad, tilt_rad=at.tilt_rad)
            daemon.service.clock.sleep(3.0)  # so long that what is clicked was exposed here
        for _ in range(2):  # a buffer's first picture is of before
            frame_id = client.snapshot(PAIR[0]).frame_id
        place_m = rover.true_point(*camera_and_sequence(frame_id), pixel_px)
        assert place_m is not None
        begun_s = client.status()["now_s"]
        record = pointed(client, pixel=(PAIR[0], frame_id, *pixel_px), pointings=2)
        seconds = client.status()["now_s"] - begun_s
    error: Mapping[str, Any] = record["error"] or {}
    found.ended[str(error.get("code", record["state"]))] += 1
    if record["state"] == "done":
        found.seconds.append(seconds)
    settles = [step for step in record["steps"] if step["name"] == "settle"]
    for told, settled in zip(record["pointings"], settles, strict=False):
        at_rest_s = settled["started_s"] + settled["duration_s"]
        off_px = np.subtract(told["residual_px"], true_residual_px(rover, place_m, at_rest_s))
        found.off_px.append(float(np.abs(off_px).max()))
        found.off_sigma.append(float(np.abs(off_px / told["residual_sigma_px"]).max()))
    return found


def true_residual_px(rover: SimulatedRover, place_m: FloatArray, time_s: float) -> FloatArray:
    """Where the left eye truly sees a place for the joints of a moment, less its image's centre."""
    camera = rover.rig.camera_in_rover(PAIR[0], *rover.true_joints(time_s))
    return np.asarray(camera.project(place_m)[0] - rover.rig.cameras[PAIR[0]].model.image_center_px)


def row_of(key: Key, found: LateFound) -> dict[str, Any]:
    """What the table says of a speed and a lag."""
    speed, lag_s = key
    return {
        "speed_rad_per_s": speed,
        "lag": "buffered" if lag_s == BUFFERED else f"{lag_s:g} s" if lag_s else "honest",
        "operations": found.ended.total(),
        "done": found.ended["done"],
        "refused": ", ".join(f"{n} `{code}`" for code, n in found.ended.most_common() if code != "done"),
        "told": len(found.off_px),
        "false": sum(one > FALSE_SIGMAS for one in found.off_sigma),
        "worst_px": max(found.off_px, default=None),
        "worst_sigma": max(found.off_sigma, default=None),
        "median_s": statistics.median(found.seconds) if found.seconds else None,
    }


COLUMNS = {
    "rad/s": "{speed_rad_per_s:g}", "pictures": "{lag}", "operations": "{operations}", "done": "{done}",
    "refused": "{refused}", "residuals told": "{told}", "false": "{false}",
    "worst px, sigma": "{worst_px:.2f}, {worst_sigma:.1f}", "s": "{median_s:.1f}",
}  # fmt: skip


def main() -> int:
    """Point, and print a table or a document."""
    lags = "0.05,0.1,0.15,0.2,0.25,0.3,0.5,0.8,1"
    parser = options(__doc__, 12, "targets", as_json=True)
    parser.add_argument(
        "--lags", type=numbers, default=lags, metavar="S,S",
        help=f"seconds, beside honest and buffered cameras (default {lags})",
    )  # fmt: skip
    parser.add_argument(
        "--speeds", type=numbers, default="1,0.2", metavar="R,R", help="rad/s (default 1,0.2)"
    )
    parser.add_argument(
        "--repeat-after", type=float, default=1.0, metavar="S",
        help="pointing.repeat_after_s, 0: no second picture (default 1)",
    )  # fmt: skip
    parser.add_argument("--head", default="ptu_d46_70", metavar="NAME", help="preset (default ptu_d46_70)")
    args = parser.parse_args()
    lags_s = (0.0, BUFFERED, *args.lags)
    tasks = [
        LateTask(index, float(at_m), args.speeds, lags_s, args.repeat_after, args.head, args.seed)
        for index, at_m in enumerate(np.geomspace(2.0, 8.0, args.cases))
    ]
    label = "target {0.index} at {0.distance_m:.1f} m".format
    results = run_cases(args, "targets", point, tasks, label)
    rows = []
    for key in product(args.speeds, lags_s):
        found = LateFound()
        for one in results:
            found += one.get(key, LateFound())
        rows.append(row_of(key, found))
    show(args, rows, COLUMNS)
    return 0


if __name__ == "__main__":
    end(main)
