"""One run of the pointing experiment through the devices of the virtual machine, and its record."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from drivers.sim.kept import kept_home
from hil_tests.support.closed_loop import files
from hil_tests.support.living_daemon import started
from hil_tests.support.virtual_machine import boot
from mastctl.cli.options import at_least, positive_number
from mastctl.client import Client
from mastctl.experiment.pointing import PointingExperiment, TargetRecord, run_pointing_experiment
from tools.command import end

REPOSITORY = Path(__file__).resolve().parents[3]
RECORD = "record.json"


def through_devices(kernel: Path, out: Path, options: list[str], timeout_s: float) -> dict[str, Any]:
    """Run in the virtual machine and return the record.

    Raises
    ------
    boot.VmFailed
        If the machine or the run in it failed: its last lines.
    """
    command = [sys.executable, "-m", "hil_tests.support.closed_loop.run", *options, "--out", "/run/out"]
    # the machine has a home of its own, which is empty: what was compiled here is read from here
    kept = str(kept_home().parent)
    environment = {"PYTHONPATH": str(REPOSITORY), "OPENBLAS_NUM_THREADS": "1", "XDG_CACHE_HOME": kept}
    result = boot.run(
        kernel, command, out, folder=REPOSITORY, cameras=boot.CAMERAS["hdmi"], timeout_s=timeout_s,
        environment=environment,
    )  # fmt: skip
    if result.status != 0 or not (out / RECORD).is_file():
        raise boot.VmFailed(f"the run ended with {result.status}:\n{result.console[-3000:]}")
    record: dict[str, Any] = json.loads((out / RECORD).read_text())
    return record


def main() -> int:
    """In the machine: run on capture nodes and a serial line, and keep the record."""
    from hil_tests.support.closed_loop.world import LoopWorld, WorldTruth

    parser = argparse.ArgumentParser()
    parser.add_argument("--targets", type=at_least(1), required=True)
    parser.add_argument("--distances", type=positive_number, nargs="+", required=True)
    parser.add_argument("--seed", type=at_least(0), required=True)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="closed-loop-") as name:
        folder = Path(name)
        files.write_rig(folder)
        with LoopWorld(folder / "rig.yaml", args.seed) as world:
            config = files.through_devices(folder, world.port, world.head)
            with started(config) as (_, port), Client(f"http://127.0.0.1:{port}") as client:
                document = _experiment(client, WorldTruth(world, client), args)
            (args.out / RECORD).write_text(json.dumps({**document, **world.facts()}, indent=1))
    return 0


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
