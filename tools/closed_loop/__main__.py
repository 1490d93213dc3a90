"""The pointing experiment in memory and through real devices, with the same rig, scene, seed and head.

    .venv/bin/python -m tools.closed_loop --targets 10

In memory the head and the cameras are simulated inside the daemon. Through devices the daemon runs in the
virtual machine (tools/vm) on the kernel's own capture nodes and a servo bus that the real SDK drives over a
pseudo terminal. Prints the table of docs/evidence/validation.md; --out keeps both records.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from drivers.sim.kept import kept_home
from mastctl.cli.output import at_least, positive_number
from tools.closed_loop.run import RECORD
from tools.command import end
from tools.virtual_machine import boot, kernel

REPOSITORY = Path(__file__).resolve().parents[2]


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="tools.closed_loop", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--targets", type=at_least(1), default=10, help="at each distance (default 10)")
    parser.add_argument("--distances", type=positive_number, nargs="+", default=[10.0, 6.0, 2.0], metavar="M")
    parser.add_argument("--seed", type=at_least(0), default=1)
    parser.add_argument("--timeout", type=positive_number, default=3600.0, metavar="S", help="of the machine")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where the records are kept")
    args = parser.parse_args()
    if (found := kernel.find()) is None:
        print("tools.closed_loop: the kernel is not built; run tools/vm setup", file=sys.stderr)
        return 1
    distances = [f"{distance:g}" for distance in args.distances]
    options = ["--targets", str(args.targets), "--seed", str(args.seed), "--distances", *distances]
    with tempfile.TemporaryDirectory(prefix="closed-loop-") as scratch:
        out = (args.out or Path(scratch)).resolve()
        try:
            memory, devices = (
                in_memory(out / "memory", options),
                through_devices(found, out / "devices", options, args.timeout, show=True),
            )
        except (boot.VmFailed, subprocess.CalledProcessError) as error:
            print(f"tools.closed_loop: {error}", file=sys.stderr)
            return 1
    print(table(memory, devices))
    return 0


def in_memory(out: Path, options: list[str]) -> dict[str, Any]:
    """Run on this machine and return the record."""
    out.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "tools.closed_loop.run", "memory", *options, "--out", str(out)]
    subprocess.run(command, cwd=REPOSITORY, env={**os.environ, "PYTHONPATH": str(REPOSITORY)}, check=True)
    return _record(out)


def through_devices(
    found: Path, out: Path, options: list[str], timeout_s: float, show: bool = False
) -> dict[str, Any]:
    """Run in the virtual machine and return the record.

    Raises
    ------
    boot.VmFailed
        If the machine or the run in it failed: its last lines.
    """
    out.mkdir(parents=True, exist_ok=True)
    (out / RECORD).unlink(missing_ok=True)
    command = [sys.executable, "-m", "tools.closed_loop.run", "devices", *options, "--out", "/run/out"]
    # the machine has a home of its own, which is empty: what was compiled here is read from here
    kept = str(kept_home().parent)
    environment = {"PYTHONPATH": str(REPOSITORY), "OPENBLAS_NUM_THREADS": "1", "XDG_CACHE_HOME": kept}
    result = boot.run(
        found, command, out, folder=REPOSITORY, cameras=boot.CAMERAS["hdmi"], timeout_s=timeout_s,
        environment=environment, show=show,
    )  # fmt: skip
    if result.status != 0 or not (out / RECORD).is_file():
        raise boot.VmFailed(f"the run ended with {result.status}:\n{result.console[-3000:]}")
    return _record(out)


def _record(out: Path) -> dict[str, Any]:
    record: dict[str, Any] = json.loads((out / RECORD).read_text())
    return record


def table(memory: dict[str, Any], devices: dict[str, Any]) -> str:
    """Return both runs beside one another, and how far apart they are, as Markdown."""
    rows = [["rms px (x, y)", *(f"{row['distance_m']:g} m" for row in memory["distances"])]]
    rows.append(["---"] * len(rows[0]))
    for words, key in (("first pointing", "first_rms_px"), ("second pointing", "second_rms_px")):
        for kind, prefix in (("measured", ""), ("true", "true_")):
            for place, record in (("in memory", memory), ("through devices", devices)):
                cells = [_pair(row.get(prefix + key)) for row in record["distances"]]
                rows.append([f"{words}, {kind}, {place}", *cells])
    for number, words in enumerate(("first", "second")):
        apart = [differences(memory, devices, row["distance_m"], number) for row in memory["distances"]]
        rows.append([f"{words}: apart, target by target", *(_pair(rms) for rms, _ in apart)])
        rows.append([f"{words}: apart by the sigmas", *(_pair(sigma) for _, sigma in apart)])
    both = zip(memory["distances"], devices["distances"], strict=True)
    cells = [f"{one['failed']}, {other['failed']} of {one['targets']}" for one, other in both]
    rows.append(["failed: in memory, through devices", *cells])
    lines = [f"| {' | '.join(cells)} |" for cells in rows]
    facts = f"{devices['pictures']} pictures drawn, the slowest in {devices['drawing_s']} s"
    return "\n".join([*lines, "", f"{facts}; the head moved unseen for at most {devices['blind_s']} s"])


def differences(memory: dict[str, Any], devices: dict[str, Any], distance_m: float, number: int) -> Any:
    """Return the rms of the differences of both runs' residuals, and what their sigmas make of it.

    Compared are targets of the same view that landed in both runs. The pixel that is clicked may be another,
    as noise is another: then the residuals differ by more than their sigmas.
    """
    apart, expected = [], []
    for one, other in zip(memory["records"], devices["records"], strict=True):
        if (
            one["distance_m"] == distance_m
            and min(len(one["residuals_px"]), len(other["residuals_px"])) > number
        ):
            apart.append(np.subtract(one["residuals_px"][number], other["residuals_px"][number]))
            expected.append(np.hypot(one["sigmas_px"][number], other["sigmas_px"][number]))
    if not apart:
        return None, None
    return tuple(np.sqrt(np.mean(np.square(v), axis=0)) for v in (apart, expected))


def _pair(value: Any) -> str:
    return "-" if value is None else f"{value[0]:.3f}, {value[1]:.3f}"


if __name__ == "__main__":
    end(main)
