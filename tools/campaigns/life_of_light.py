"""What each of the simulated cameras' options costs the pointing loop, in pixels, each alone and all at once.

    .venv/bin/python -m tools.campaigns.life_of_light [--config FILE] [--targets 4] [--seed 1] [--json]

Each option of the configuration's cameras is put on the packaged rover and the pointing experiment is run on
it, at the simulation's own speed ``max``: residuals of the left Navcam, rms px (x, y) over all distances, as
measured and (true) as the simulator knows. Two rows are between these: none of the options, and all of them.
What the head does on that day is in `tools.campaigns.life`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from drivers.errors import DriverError
from mastctl.cli.output import at_least
from mastctl.cli.tasks import add_task_options, results_of
from mastctl.config import load_config
from mastctl.packaged import config_folder
from tools.arguments import end

OPTIONS: Mapping[str, tuple[str, ...]] = {
    "none of them": (),
    "smear and rolling shutter": ("smear", "row_time_s"),
    "automatic exposure": ("exposure",),
    "falloff": ("lens.falloff",),
    "defocus": ("lens.f_number", "lens.focus_m", "lens.pitch_um"),
    "dust": ("lens.dust", "lens.dust_um", "lens.dust_gap_um"),
    "colour": ("colour",),
    "JPEG": ("jpeg_quality",),
    "all of them": ("smear", "row_time_s", "exposure", "lens", "colour", "jpeg_quality"),
}


@dataclass(frozen=True)
class Trial:
    """An option, the section ``cameras`` that is it, and the targets."""

    option: str
    cameras: Mapping[str, Any]
    targets: int
    seed: int


class Row(NamedTuple):
    """Rms px (x, y) over all targets; ``failed``: targets without a residual."""

    option: str
    first_px: tuple[float, float]
    second_px: tuple[float, float]
    true_second_px: tuple[float, float]
    failed: int


def main() -> int:
    """Measure, and print a table or a document."""
    worst = config_folder() / "worst_day.yaml"
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--config", type=Path, default=worst, metavar="FILE", help="(default worst_day.yaml)")
    parser.add_argument("--targets", type=at_least(1), default=4, metavar="N", help="a distance (default 4)")
    parser.add_argument("--seed", type=at_least(0), default=1, metavar="S", help="of the targets (default 1)")
    parser.add_argument("--json", action="store_true", help="one JSON document")
    add_task_options(parser)
    args = parser.parse_args()
    cameras = load_config(args.config).hardware.simulation.get("cameras", {})
    trials = [Trial(option, only(cameras, keys), args.targets, args.seed) for option, keys in OPTIONS.items()]
    rows = results_of(args, "options", pointed, trials, lambda trial: trial.option)
    if rows is None:
        return 0
    if args.json:
        print(json.dumps([row._asdict() for row in rows]))
        return 0
    for row in rows:
        print(told(row))
    return 0


def told(row: Row) -> str:
    """A line of the table."""
    cells = ("{:.3f}, {:.3f}".format(*px) for px in (row.first_px, row.second_px, row.true_second_px))
    return f"| {row.option} | {' | '.join(cells)} | {row.failed} |"


def only(cameras: Mapping[str, Any], keys: tuple[str, ...]) -> dict[str, Any]:
    """The section with some keys alone, ``a.b`` for one of a part."""
    kept: dict[str, Any] = {}
    for key in keys:
        part, _, name = key.partition(".")
        if part in cameras and not name:
            kept[part] = cameras[part]
        elif name in cameras.get(part, {}):
            kept.setdefault(part, {})[name] = cameras[part][name]
    return kept


def pointed(trial: Trial) -> Row:
    """The pointing experiment on the packaged rover with such cameras."""
    folder = config_folder()
    config = yaml.safe_load((folder / "default.yaml").read_text())
    config["mast_file"] = str(folder / config["mast_file"])
    config["simulation"]["rover"] = str(folder / config["simulation"]["rover"])
    config["simulation"]["cameras"] = dict(trial.cameras)
    with tempfile.TemporaryDirectory() as where:
        file = Path(where, "config.yaml")
        file.write_text(yaml.safe_dump(config))
        command = [sys.executable, "-m", "mastctl", "demo", "--config", str(file), "--speed", "max", "--json"]
        command += [
            "--targets",
            str(trial.targets),
            "--seed",
            str(trial.seed),
            "--out",
            str(Path(where, "out")),
        ]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    try:
        distances = json.loads(done.stdout)["distances"]
    except (ValueError, KeyError):
        raise DriverError(f"the experiment with {trial.option} did not run: {done.stderr[-300:]}") from None

    def rms(key: str) -> tuple[float, float]:
        x_px, y_px = np.sqrt(np.mean(np.square([distance[key] for distance in distances]), axis=0))
        return float(x_px), float(y_px)

    failed = sum(distance["failed"] for distance in distances)
    return Row(trial.option, rms("first_rms_px"), rms("second_rms_px"), rms("true_second_rms_px"), failed)


if __name__ == "__main__":
    end(main)
