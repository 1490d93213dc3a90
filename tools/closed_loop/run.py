"""One run of the experiment, in memory or, inside the virtual machine, through devices; leaves a record.

python -m tools.closed_loop.run devices --targets 3 --distances 6 --out FOLDER
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mastctl.cli.output import at_least, positive_number
from mastctl.client import Client
from mastctl.config import load_config
from mastctl.daemon import RunningDaemon
from mastctl.experiment.pointing import PointingExperiment, TargetRecord, run_pointing_experiment
from mastctl.experiment.simulated import SimulationTruth
from tools.closed_loop import files
from tools.command import end

RECORD = "record.json"


def main() -> int:
    parser = argparse.ArgumentParser(prog="tools.closed_loop.run", description=__doc__.splitlines()[0])
    parser.add_argument("kind", choices=("memory", "devices"))
    parser.add_argument("--targets", type=at_least(1), default=10, help="at each distance")
    parser.add_argument("--distances", type=positive_number, nargs="+", default=[10.0, 6.0, 2.0], metavar="M")
    parser.add_argument("--seed", type=at_least(0), default=1)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="closed-loop-") as name:
        run = in_memory if args.kind == "memory" else through_devices
        document = run(Path(name), args)
    (args.out / RECORD).write_text(json.dumps(document, indent=1))
    return 0


def in_memory(folder: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Run on the simulated rover in memory."""
    files.write_rig(folder)
    config = load_config(files.in_memory(folder, args.seed))
    with RunningDaemon(config) as daemon, Client(daemon.url) as client:
        assert daemon.hardware.simulation is not None
        return _experiment(client, SimulationTruth(daemon.hardware.simulation), args)


def through_devices(folder: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Run on capture nodes and a serial line, with the world behind them, and a daemon of its own."""
    from tools.closed_loop.world import LoopWorld, WorldTruth

    files.write_rig(folder)
    with LoopWorld(folder / "rig.yaml", args.seed) as world:
        config = files.through_devices(folder, world.port, world.head)
        with _daemon(config) as url, Client(url) as client:
            document = _experiment(client, WorldTruth(world, client), args)
        return {**document, **world.facts()}


@contextmanager
def _daemon(config: Path) -> Iterator[str]:
    """``mastctl run`` as a process; gives its address."""
    command = [sys.executable, "-m", "mastctl", "run", "--config", str(config)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        if not (url := process.stdout.readline().strip()):
            raise RuntimeError(f"the daemon ended with {process.wait()} before it was ready")
        yield url
    finally:
        process.terminate()
        process.wait(30)


def _experiment(client: Client, truth: Any, args: argparse.Namespace) -> dict[str, Any]:
    """The pointing experiment, and what its record is to hold."""
    experiment = run_pointing_experiment(
        client, targets=args.targets, distances_m=args.distances, seed=args.seed, truth=truth, on_target=_tell
    )
    return {**experiment.as_json(), "records": _records(experiment)}


def _tell(record: TargetRecord) -> None:
    """One line a target, for whoever waits."""
    print(
        f"{record.distance_m:g} m, {record.index}: {record.error or 'done'} ({record.seconds:.1f} s)",
        flush=True,
    )


def _records(experiment: PointingExperiment) -> list[dict[str, Any]]:
    """What happened to each target, for comparisons."""
    return [
        {
            "distance_m": record.distance_m,
            "index": record.index,
            "clicked_px": record.clicked_px,
            "pan_before_rad": record.pan_before_rad,
            "tilt_before_rad": record.tilt_before_rad,
            "error": record.error,
            "residuals_px": [landing.residual_px for landing in record.landings],
            "sigmas_px": [landing.sigma_px for landing in record.landings],
            "true_px": [landing.true_px for landing in record.landings],
            "seconds": round(record.seconds, 1),
        }
        for record in experiment.records
    ]


if __name__ == "__main__":
    end(main)
