"""What joint terms in the mast file are worth: pointing a simulated 12-bit head whose encoders and gears err.

    .venv/bin/python -m tools.campaigns.joints [--cases 8] [--distances 10,6,2] [--seed 1] [--json]
    .venv/bin/python -m tools.campaigns.joints --calibrated [--keep DIR]

The packaged rover with a Dynamixel X head, its belief the packaged mast file, through a daemon. Cases: counts
alone (no play, encoders that read true); encoder harmonics of 6 and 2 mrad and play of 4 mrad with ``joints``
in the mast file that state them; the same without; and with them, each goal approached from one side by the
driver. Told are rms of the true residual, px an axis, of the first and the second pointing, how many times
the first is what counts alone allow, and the rover's seconds a target.

``--calibrated``: what a driven bench is worth on such a head. Of the packaged bench only the drawing is
known. `mastctl calibrate bench` drives it before a simulated A2 board; the mast file that comes out points
the same head: as it is, and without its joints. Beside it what whole counts alone allow: a head of the same
counts without errors, its mast file the true rig.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from calib.files.mast_file import load_rig, save_rig
from calib.files.yaml_text import dump_mapping
from calib.geometry.rig import AxisJoint, JointErrors, Rig
from calib.targets.board_file import save_board
from calib.targets.boards import Charuco
from mastctl.cli.main import main as mastctl
from mastctl.client import Client
from mastctl.config import Config, Listen, load_config
from mastctl.daemon import RunningDaemon
from mastctl.experiment.pointing import PointingExperiment, run_pointing_experiment
from mastctl.experiment.simulated import SimulationTruth, demo_config
from mastctl.packaged import config_folder
from tools.command import end, numbers, options, rms, run_cases, show

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

A2_BOARD = Charuco(10, 6, 0.055, 0.04125)
BENCH_HEAD = {"preset": "dynamixel_x", **ERRS}
COUNTS_ALONE = {"preset": "dynamixel_x", "backlash_rad": 0.0}


@dataclass(frozen=True)
class JointsCase:
    """A head, and what the mast file says of its joints."""

    name: str
    head: tuple[tuple[str, Any], ...]
    told: bool


CASES = (
    JointsCase("counts alone", (("backlash_rad", 0.0),), False),
    JointsCase("joints told", tuple(ERRS.items()), True),
    JointsCase("joints not told", tuple(ERRS.items()), False),
    JointsCase(
        "joints told, approached from one side", (*ERRS.items(), ("approach_rad", APPROACH_RAD)), True
    ),
)


@dataclass(frozen=True)
class JointsTask:
    """Targets of one case at one distance."""

    case: JointsCase
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


def found_in(done: PointingExperiment) -> JointsFound:
    """Return what an experiment found."""
    landed = [[one.true_px for one in record.landings if one.true_px] for record in done.records]
    return JointsFound(
        [row[0] for row in landed if row],
        [row[1] for row in landed if len(row) > 1],
        done.seconds,
        [record.error for record in done.records if record.error],
    )


def point(task: JointsTask) -> JointsFound:
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
            return found_in(
                run_pointing_experiment(
                    client,
                    targets=task.targets,
                    distances_m=(task.distance_m,),
                    seed=task.seed,
                    truth=SimulationTruth(daemon.hardware.simulation),
                )
            )


COLUMNS = {
    "case": "{case}", "targets": "{targets}", "first, rms px": "{first_rms_px:.2f}",
    "second": "{second_rms_px:.2f}", "times counts alone": "{times_counts_alone:.2f}", "s": "{seconds:.1f}",
}  # fmt: skip


def main() -> int:
    """Point, and print a table or a document."""
    parser = options(__doc__, 8, "targets a distance", as_json=True)
    parser.add_argument("--distances", type=numbers, default="10,6,2", metavar="M,M", help="(default 10,6,2)")
    parser.add_argument(
        "--calibrated", action="store_true", help="by what a driven bench finds of the joints"
    )
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep the bench and its report there")
    args = parser.parse_args()
    if args.calibrated:
        return _calibrated(args)
    tasks = [JointsTask(case, at_m, args.cases, args.seed) for case in CASES for at_m in args.distances]
    found = run_cases(
        args, "targets", point, tasks, lambda task: f"{task.case.name} at {task.distance_m:g} m"
    )
    rows: list[dict[str, Any]] = []
    for case in CASES:
        mine = [one for task, one in zip(tasks, found, strict=True) if task.case == case]
        rows.append(row_of(case.name, mine, rows))
    show(args, rows, COLUMNS, "errors")
    return 0


def row_of(name: str, mine: Sequence[JointsFound], before: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a row of the table; the first of those before is what counts alone allow."""
    first = [px for one in mine for px in one.first_px]
    second = [px for one in mine for px in one.second_px]
    return {
        "case": name,
        "targets": len(first),
        "first_rms_px": rms(first),
        "second_rms_px": rms(second),
        "times_counts_alone": rms(first) / (before[0]["first_rms_px"] if before else rms(first)),
        "seconds": sum(one.seconds for one in mine) / max(len(first), 1),
        "errors": [words for one in mine for words in one.errors],
    }


def _calibrated(args: argparse.Namespace) -> int:
    """Calibrate by the command, and point with what comes out."""
    packaged = load_config(config_folder() / "bench.yaml")
    with tempfile.TemporaryDirectory() as scratch:
        folder = args.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        mast = folder / "mast.yaml"
        if not mast.exists() and (code := calibrate(packaged, folder, mast)):
            return code
        calibrated, true = load_rig(mast).rig, true_rig(packaged)
        cases: list[tuple[str, Mapping[str, Any], Rig]] = [
            ("counts alone, the true rig", COUNTS_ALONE, true),
            ("calibrated by the command", BENCH_HEAD, calibrated),
            ("the same without joints", BENCH_HEAD, replace(calibrated, joints=JointErrors(), fit={})),
        ]
        rows: list[dict[str, Any]] = []
        for name, head, rig in cases:
            path = Path(scratch) / "points.yaml"
            save_rig(rig, path)
            simulation = {
                **packaged.hardware.simulation,
                "head": dict(head),
                "seed": args.seed,
                "speed": "max",
            }
            hardware = replace(packaged.hardware, simulation=simulation)
            config = replace(packaged, mast_file=path, hardware=hardware, listen=Listen(port=0))
            with RunningDaemon(config) as daemon, Client(daemon.url) as client:
                assert daemon.hardware.simulation is not None
                done = run_pointing_experiment(
                    client,
                    targets=args.cases,
                    distances_m=args.distances,
                    seed=args.seed,
                    truth=SimulationTruth(daemon.hardware.simulation),
                )
            rows.append(row_of(name, [found_in(done)], rows))
    show(args, rows, COLUMNS, "errors")
    return 0


def calibrate(packaged: Config, folder: Path, out: Path) -> int:
    """Run the command on the head, and return its exit code."""
    board, config = folder / "board.yaml", folder / "config.yaml"
    save_board(board, A2_BOARD)
    simulation = {**packaged.hardware.simulation, "head": BENCH_HEAD}
    simulation["rover"] = str(packaged.hardware.folder / simulation["rover"])
    document = {
        "schema": "mastctl/config/1",
        "mast_file": str(packaged.mast_file),
        "listen": {"host": "127.0.0.1", "port": 0},
        "pan_tilt": {"driver": "sim"},
        "cameras": {name: {"driver": "sim"} for name in packaged.hardware.cameras},
        "limits": {"pan_rad": [-2.6, 2.6], "tilt_rad": [-1.2, 0.5], "speed_rad_per_s": 1.0},
        "simulation": simulation,
    }
    config.write_bytes(dump_mapping(document))
    words = ["--config", config, "--board", board, "--out", out, "--report", folder / "report"]
    sys.stdout.flush()
    return mastctl(["calibrate", "bench", *map(str, words)])


def true_rig(packaged: Config) -> Rig:
    """The rig that is simulated, with the bench's cameras."""
    simulation = packaged.hardware.simulation
    rig = load_rig(packaged.hardware.folder / str(simulation["rover"])).rig
    cameras = {name: rig.cameras[name] for name in packaged.hardware.cameras}
    pairs = {name: pair for name, pair in rig.stereo.items() if set(pair) <= set(cameras)}
    return replace(rig, cameras=cameras, stereo=pairs)


if __name__ == "__main__":
    end(main)
