"""Run the pointing experiment on variants of a simulated rover; compare measured with true residuals.

    .venv/bin/python -m tools.campaigns.sweep joints|cameras|worst|late [--cases 8] [--distances 10,6,2]
    .venv/bin/python -m tools.campaigns.sweep FILE.yaml

``tools/campaigns/sweeps.yaml`` lists the variants and explains the form of a file. All variants have the same
scene and the same draw of targets. For each variant: targets and refusals; rms of the true residual after the
first and the second pointing, px an axis; z, the measured less the true residual over its sigma, of both axes
and pointings (rms, and how many exceed 3); the rover's seconds a target.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from drivers.simulation_clock import MAX
from mastctl.client import Client
from mastctl.config import Config, load_config
from mastctl.daemon import RunningDaemon
from mastctl.experiment.pointing import PointingExperiment, TargetRecord, run_pointing_experiment
from mastctl.experiment.simulated import simulation_truth
from mastctl.packaged import config_folder
from tools.command import end, numbers, options, results_of, rms, show

SWEEPS = Path(__file__).with_name("sweeps.yaml")
PAIR = ("navcam_left", "navcam_right")
FALSE_SIGMAS = 3.0

Changes = Mapping[str, Any]
"""Paths in a configuration, with dots, to values; None removes."""


@dataclass(frozen=True)
class Variant:
    """One target of one variant of a packaged configuration."""

    packaged: str
    name: str
    changes: Changes
    distance_m: float
    index: int
    seed: int


def sweep_named(name: str) -> tuple[str, dict[str, Changes]]:
    """Return the packaged configuration and the variants of a sweep, by its name or the path of a file."""
    path = Path(name) if name.endswith(".yaml") else SWEEPS
    document = yaml.safe_load(path.read_text(encoding="utf-8"))
    cases = dict(document if path != SWEEPS else document[name])
    return cases.pop("packaged", "default.yaml"), cases


def changed(document: dict[str, Any], changes: Changes) -> dict[str, Any]:
    """Return a copy of a YAML document with values at dotted paths changed or removed."""
    document = deepcopy(document)
    for path, value in changes.items():
        *sections, key = path.split(".")
        place = document
        for section in sections:
            place = place.setdefault(section, {})
        if value is None:
            place.pop(key, None)
        else:
            place[key] = deepcopy(value)
    return document


def config_of(variant: Variant, folder: Path) -> Config:
    """Write a variant's configuration and mast file into a folder, and load it.

    Raises
    ------
    BadFile
        If the changes make it invalid.
    """
    packaged = config_folder() / variant.packaged
    document = yaml.safe_load(packaged.read_text(encoding="utf-8"))
    mast = yaml.safe_load((packaged.parent / document["mast_file"]).read_text(encoding="utf-8"))
    of_mast = {key.removeprefix("mast."): v for key, v in variant.changes.items() if key.startswith("mast.")}
    rest = {k: v for k, v in variant.changes.items() if not k.startswith("mast.") and k != "faults"}
    document = changed(document, rest)
    document["mast_file"], document["listen"] = "mast.yaml", {"port": 0}
    document["cameras"] = {name: document["cameras"][name] for name in PAIR}
    simulation = document["simulation"]
    simulation |= {"seed": variant.seed, "speed": MAX}
    simulation["rover"] = str(packaged.parent / simulation["rover"])
    (folder / "mast.yaml").write_text(yaml.safe_dump(changed(mast, of_mast)), encoding="utf-8")
    (folder / "rover.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
    return load_config(folder / "rover.yaml")


def point(variant: Variant) -> PointingExperiment:
    """Point twice at one target of a variant, on a rover of its own."""
    with (
        tempfile.TemporaryDirectory() as folder,
        RunningDaemon(config_of(variant, Path(folder))) as daemon,
        Client(daemon.url) as client,
    ):
        for fault, settings in variant.changes.get("faults", {}).items():
            for camera in PAIR:
                client.set_fault(camera, fault, **settings)
        rover = daemon.hardware.simulation
        assert rover is not None
        return run_pointing_experiment(
            client,
            targets=1,
            first=variant.index,
            distances_m=(variant.distance_m,),
            seed=variant.seed,
            truth=simulation_truth(rover),
        )


def row_of(name: str, records: list[TargetRecord], seconds: float) -> dict[str, Any]:
    """Return a row of the table for all targets of a variant."""
    landings = [[one for one in record.landings if one.true_px] for record in records]
    z = [np.subtract(one.residual_px, one.true_px or ()) / one.sigma_px for row in landings for one in row]
    refused = Counter(record.error.partition(":")[0] for record in records if record.error)
    return {
        "variant": name,
        "targets": len(records),
        "refused": ", ".join(f"{count} `{code}`" for code, count in refused.most_common()),
        "first_rms_px": rms([row[0].true_px for row in landings if row]),
        "second_rms_px": rms([row[1].true_px for row in landings if len(row) > 1]),
        "z_rms": rms(z),
        "beyond_3": int(sum(np.abs(one).max() > FALSE_SIGMAS for one in z)),
        "seconds": seconds / max(len(records), 1),
    }


COLUMNS = {
    "variant": "{variant}", "targets": "{targets}", "refused": "{refused}",
    "true first, rms px": "{first_rms_px:.3f}", "second": "{second_rms_px:.3f}", "z rms": "{z_rms:.2f}",
    "beyond 3": "{beyond_3}", "s": "{seconds:.1f}",
}  # fmt: skip


def main() -> int:
    """Point, and print a table or a document."""
    parser = options(__doc__, 8, "targets a distance", as_json=True)
    parser.add_argument("sweep", help="a sweep of tools/campaigns/sweeps.yaml, or a YAML file of one's own")
    parser.add_argument("--distances", type=numbers, default="10,6,2", metavar="M,M", help="(default 10,6,2)")
    args = parser.parse_args()
    try:
        packaged, cases = sweep_named(args.sweep)
    except KeyError:
        names = ", ".join(yaml.safe_load(SWEEPS.read_text(encoding="utf-8")))
        parser.error(f"{args.sweep!r} is not a sweep; there are {names}, and files that end in .yaml")
    variants = [
        Variant(packaged, name, changes, distance_m, index, args.seed)
        for name, changes in cases.items()
        for distance_m in args.distances
        for index in range(args.cases)
    ]
    label = "{0.name}, {0.distance_m:g} m, target {0.index}".format
    found = results_of(args, "targets", point, variants, label)
    rows = []
    for name in cases:
        mine = [done for variant, done in zip(variants, found, strict=True) if variant.name == name]
        records = [record for done in mine for record in done.records]
        rows.append(row_of(name, records, sum(done.seconds for done in mine)))
    show(args, rows, COLUMNS)
    return 0


if __name__ == "__main__":
    end(main)
