"""What a driven bench is worth on a head whose encoders and gears err: calibrated by the command, pointed.

    .venv/bin/python -m tools.campaigns.bench_driven [--cases 8] [--distances 10,6,2] [--keep DIR]

The packaged bench with a Dynamixel X head: harmonics of 6 and 2 mrad in both encoders, 4 mrad of play. Of it
only the drawing is known. `mastctl calibrate bench` drives it before a simulated A2 board; the mast file that
comes out points the same head through a daemon: as it is, and without its joints. Beside it what whole counts
alone allow: a head of the same counts without errors, its mast file the true rig. Told are the targets, rms
of the true residual of the first pointing, px an axis, how many times what counts allow, and the second's.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from calib.files.mast_file import load_rig, save_rig
from calib.files.yaml_text import dump_mapping
from calib.geometry.rig import JointErrors, Rig
from calib.targets.board_file import save_board
from calib.targets.boards import Charuco
from mastctl.cli.main import main as mastctl
from mastctl.client import Client
from mastctl.config import Config, Listen, load_config
from mastctl.daemon import RunningDaemon
from mastctl.experiment.pointing import run_pointing_experiment
from mastctl.experiment.simulated import SimulationTruth
from mastctl.packaged import config_folder
from tools.arguments import end
from tools.campaign import heading, line, numbers, options, rms
from tools.campaigns.joints import ERRS

A2_BOARD = Charuco(10, 6, 0.055, 0.04125)
HEAD = {"preset": "dynamixel_x", **ERRS}
COUNTS_ALONE = {"preset": "dynamixel_x", "backlash_rad": 0.0}


def main() -> int:
    """Calibrate, point, and print a table."""
    parser = options(__doc__, 8, "targets a distance", tasks=False)
    parser.add_argument("--distances", type=numbers, default="10,6,2", metavar="M,M", help="(default 10,6,2)")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep the bench and its report there")
    args = parser.parse_args()
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
            ("calibrated by the command", HEAD, calibrated),
            ("the same without joints", HEAD, replace(calibrated, joints=JointErrors(), fit={})),
        ]
        counts_px = 0.0
        print(heading(("case", "targets", "first, rms px", "times counts alone", "second")))
        for name, head, rig in cases:
            path = Path(scratch) / "points.yaml"
            save_rig(rig, path)
            first, second, errors = pointed(packaged, head, path, args.cases, args.distances, args.seed)
            counts_px = counts_px or rms(first)
            times = rms(first) / counts_px
            cells = (f"{rms(first):.2f}", f"{times:.2f}", f"{rms(second):.2f}")
            print(line(name, len(first), *cells), flush=True)
            for words in errors:
                print(f"  {words}")
    return 0


def calibrate(packaged: Config, folder: Path, out: Path) -> int:
    """Run the command on the head, and return its exit code."""
    board, config = folder / "board.yaml", folder / "config.yaml"
    save_board(board, A2_BOARD)
    simulation = {**packaged.hardware.simulation, "head": HEAD}
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


def pointed(
    packaged: Config,
    head: Mapping[str, Any],
    mast_file: Path,
    targets: int,
    distances_m: tuple[float, ...],
    seed: int,
) -> tuple[list[tuple[float, float]], list[tuple[float, float]], list[str]]:
    """True residuals of first and second pointings, and what failed."""
    simulation = {**packaged.hardware.simulation, "head": dict(head), "seed": seed, "speed": "max"}
    hardware = replace(packaged.hardware, simulation=simulation)
    config = replace(packaged, mast_file=mast_file, hardware=hardware, listen=Listen(port=0))
    with RunningDaemon(config) as daemon, Client(daemon.url) as client:
        assert daemon.hardware.simulation is not None
        done = run_pointing_experiment(
            client,
            targets=targets,
            distances_m=distances_m,
            seed=seed,
            truth=SimulationTruth(daemon.hardware.simulation),
        )
    landed = [[one.true_px for one in record.landings if one.true_px] for record in done.records]
    return (
        [row[0] for row in landed if row],
        [row[1] for row in landed if len(row) > 1],
        [record.error for record in done.records if record.error],
    )


if __name__ == "__main__":
    end(main)
