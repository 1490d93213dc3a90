"""The simulator's control tables against the tables in the SDK's wheel."""

from __future__ import annotations

import functools
import math
import re
from pathlib import Path

import dynamixel_easy_sdk
import pytest

from drivers.sim.wire.dynamixel_models import MODELS, SimulatedModel

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
        # The older tables of the wheel have no Startup Configuration and Backup Ready (firmware 45 on).
        extra = {key for key in ours - theirs if key[2] not in ("startup_configuration", "backup_ready")}
        assert not extra, name
        assert not theirs - ours, name


def test_indirect_blocks() -> None:
    for name in MODELS:
        model = MODELS[name]
        rows = {
            row[2]: int(row[0]) for row in sections(name)["control table"] if row[2].startswith("Indirect")
        }
        first = model.indirect[0]
        assert first.address == rows["Indirect Address 1"], name
        assert first.data == rows["Indirect Data 1"], name
        kinds = model.indirect_bytes
        for word, kind in (("Address", "address"), ("Data", "data")):
            for end in ("Write", "Read"):
                assert kinds[rows[f"Indirect {word} {end}"]][0] == kind, name
        # The k-th address goes with the k-th data byte, also where the wheel splits writing from reading.
        at = rows["Indirect Address Read"], rows["Indirect Data Read"]
        assert kinds[at[0]][1] == 2 * kinds[at[1]][1], name


def test_model_number() -> None:
    for name in MODELS:
        index = dict(line.split() for line in (FOLDER / "dynamixel.model").read_text().splitlines()[1:])
        assert index[str(MODELS[name].number)] == f"{name}.model", name


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


def signed_names(model: SimulatedModel) -> set[str]:
    return {r.name for r in model.registers if r.low < 0}


def test_the_tables_are_sound() -> None:
    for name in MODELS:
        model = MODELS[name]
        used = [byte for r in model.registers for byte in range(r.address, r.address + r.size)]
        used += model.indirect_bytes
        assert len(used) == len(set(used)), name
        for register in model.registers:
            assert register.low <= register.high, name
            assert (
                not register.writable
                or register.low <= register.initial <= register.high
                or (register.name.startswith("goal_"))
            )
            assert register.from_bytes(register.to_bytes(register.low)) == register.low, name
            assert register.from_bytes(register.to_bytes(register.high)) == register.high, name
        assert {"homing_offset", "present_position", "present_velocity", "goal_position"} <= signed_names(
            model
        ), name
