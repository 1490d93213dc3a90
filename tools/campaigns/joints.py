"""What joint terms in the mast file are worth: pointing a simulated 12-bit head whose encoders and gears err.

    .venv/bin/python -m tools.campaigns.joints [--cases 8] [--distances 10,6,2] [--seed 1] [--json]

The packaged rover with a Dynamixel X head, its belief the packaged mast file, through a daemon. Cases: counts
alone (no play, encoders that read true); encoder harmonics of 6 and 2 mrad and play of 4 mrad with ``joints``
in the mast file that state them; the same without; and with them, each goal approached from one side by the
driver. Told are rms of the true residual, px an axis, of the first and the second pointing, how many times
the first is what counts alone allow, and the rover's seconds a target.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from calib.files.mast_file import load_rig, save_rig
from calib.geometry.rig import AxisJoint, JointErrors
from mastctl.client import Client
from mastctl.config import load_config
from mastctl.daemon import RunningDaemon
from mastctl.experiment.pointing import run_pointing_experiment
from mastctl.experiment.simulated import SimulationTruth, demo_config
from tools.arguments import end
from tools.campaign import numbers, options, rms, run_cases, show

BACKLASH_RAD = 0.004
APPROACH_RAD = 0.02
HARMONICS = {
    "pan": ((0.0045, -0.0040), (0.0012, 0.0016)),  # 6.0 and 2.0 mrad
    "tilt": ((-0.0040, 0.0045), (0.0016, -0.0012)),
}
ERRS: Mapping[str, Any] = {
    "backlash_rad": BACKLASH_RAD,
    "pan_harmonics_rad": HARMONICS["pan"],
    "tilt_harmonics_rad": HARMONICS["tilt"],
}
TRUTH = JointErrors(AxisJoint(HARMONICS["pan"], BACKLASH_RAD), AxisJoint(HARMONICS["tilt"], BACKLASH_RAD))


@dataclass(frozen=True)
class Case:
    """A head, and what the mast file says of its joints."""

    name: str
    head: tuple[tuple[str, Any], ...]
    told: bool


CASES = (
    Case("counts alone", (("backlash_rad", 0.0),), False),
    Case("joints told", tuple(ERRS.items()), True),
    Case("joints not told", tuple(ERRS.items()), False),
    Case("joints told, approached from one side", (*ERRS.items(), ("approach_rad", APPROACH_RAD)), True),
)


@dataclass(frozen=True)
class Task:
    """Targets of one case at one distance."""

    case: Case
    distance_m: float
    targets: int
    seed: int


@dataclass(frozen=True)
class JointsFound:
    """True residuals (n, 2) of the first and the second pointings, the rover's seconds, what failed."""

    first_px: list[tuple[float, float]]
    second_px: list[tuple[float, float]]
    seconds: float
    errors: list[str]


def point(task: Task) -> JointsFound:
    """Point at the targets of a task, on a rover of its own."""
    config = demo_config(load_config(None), head=None, seed=task.seed)
    head = {"preset": "dynamixel_x", **dict(task.case.head)}
    hardware = replace(config.hardware, simulation={**config.hardware.simulation, "head": head})
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mast.yaml"
        rig = load_rig(config.mast_file).rig
        save_rig(replace(rig, joints=TRUTH) if task.case.told else rig, path)
        config = replace(config, mast_file=path, hardware=hardware)
        with RunningDaemon(config) as daemon, Client(daemon.url) as client:
            assert daemon.hardware.simulation is not None
            done = run_pointing_experiment(
                client,
                targets=task.targets,
                distances_m=(task.distance_m,),
                seed=task.seed,
                truth=SimulationTruth(daemon.hardware.simulation),
            )
    landed = [[one.true_px for one in record.landings if one.true_px] for record in done.records]
    return JointsFound(
        [row[0] for row in landed if row],
        [row[1] for row in landed if len(row) > 1],
        done.seconds,
        [record.error for record in done.records if record.error],
    )


COLUMNS = {
    "case": "{case}", "targets": "{targets}", "first, rms px": "{first_rms_px:.2f}",
    "second": "{second_rms_px:.2f}", "times counts alone": "{times_counts_alone:.2f}", "s": "{seconds:.1f}",
}  # fmt: skip


def main() -> int:
    """Point, and print a table or a document."""
    parser = options(__doc__, 8, "targets a distance", as_json=True)
    parser.add_argument("--distances", type=numbers, default="10,6,2", metavar="M,M", help="(default 10,6,2)")
    args = parser.parse_args()
    tasks = [Task(case, at_m, args.cases, args.seed) for case in CASES for at_m in args.distances]
    found = run_cases(
        args, "targets", point, tasks, lambda task: f"{task.case.name} at {task.distance_m:g} m"
    )
    rows: list[dict[str, Any]] = []
    for case in CASES:
        mine = [one for task, one in zip(tasks, found, strict=True) if task.case == case]
        first = [px for one in mine for px in one.first_px]
        second = [px for one in mine for px in one.second_px]
        rows.append(
            {
                "case": case.name,
                "targets": len(first),
                "first_rms_px": rms(first),
                "second_rms_px": rms(second),
                "times_counts_alone": rms(first) / (rows[0]["first_rms_px"] if rows else rms(first)),
                "seconds": sum(one.seconds for one in mine) / max(len(first), 1),
                "errors": [words for one in mine for words in one.errors],
            }
        )
    show(args, rows, COLUMNS, "errors")
    return 0


if __name__ == "__main__":
    end(main)
