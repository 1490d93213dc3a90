"""The simulator's control tables against the tables in the SDK's wheel."""

from __future__ import annotations

import functools
import math
import re
from pathlib import Path

import dynamixel_easy_sdk
import pytest

from drivers.sim.wire.dynamixel_models import MODELS

FOLDER = Path(dynamixel_easy_sdk.__file__).parent / "control_table"
FILES = {name: f"{name}.model" for name in MODELS} | {
    name: f"{name}_fw52.model" for name in MODELS if name.startswith(("xl330", "xc330"))
}


@functools.cache
def sections(name: str) -> dict[str, list[list[str]]]:
    """Rows of a ``.model`` file by section."""
    found: dict[str, list[list[str]]] = {}
    rows: list[list[str]] = []
    for line in (FOLDER / FILES[name]).read_text().splitlines():
        if line.startswith("["):
            rows = found.setdefault(line.strip("[] \r"), [])
        elif line.strip():
            rows.append(line.rstrip("\r").split("\t"))
    return {key: rows[1:] for key, rows in found.items()}


def plain(name: str) -> str:
    """Our spelling of a name in those tables."""
    name = name.lower().replace("secondary(shadow) id", "secondary_id")
    return re.sub(r"\W+", "_", name)


def test_addresses_and_sizes() -> None:
    for name in MODELS:
        model = MODELS[name]
        theirs = {
            (int(row[0]), int(row[1]), plain(row[2]))
            for row in sections(name)["control table"]
            if not row[2].startswith("Indirect")
        }
        ours = {(r.address, r.size, r.name) for r in model.registers}
        assert not ours - theirs, name


def test_units() -> None:
    for name in MODELS:
        model = MODELS[name]
        info = {row[0]: float(row[1]) for row in sections(name)["type info"]}
        low, high = (info[f"value_of_{end}_radian_position"] for end in ("min", "max"))
        turn = (info["max_radian"] - info["min_radian"]) / math.tau
        # 4096 counts a turn are 0 to 4095; the P counts are given from -half to +half.
        counts = (high - low + (1 if low == 0 else 0)) / turn
        assert counts == pytest.approx(model.counts_per_turn, rel=1e-6), name
        assert info["value_of_zero_radian_position"] == model.zero_counts, name
        units = {row[0]: float(row[1]) for row in sections(name)["unit info"]}
        assert model.velocity_unit_rad_per_s == pytest.approx(units["Present Velocity"], rel=2e-3), name
