"""The tables of docs/reference/configuration.md: keys, needed or default, and bounds come from the schemas.

A cell may say more behind what is generated, after a comma, a semicolon or a bracket. A cell that the readers
cannot fill (a default that hangs on the model, say) is the author's, and so is the meaning.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from tools.schemas.files import NAMES, schema_of
from tools.schemas.watched import Schema, mapping_in

TABLES = {
    "A whole configuration": (),
    "Options of `dynamixel`": ("pan_tilt", "dynamixel"),
    "Options of `feetech`": ("pan_tilt", "feetech"),
    "Options of `flir_ptu`": ("pan_tilt", "flir_ptu"),
    "Options of `pelco`": ("pan_tilt", "pelco"),
    "Options of `visca`": ("pan_tilt", "visca"),
    "Options of `v4l2`": ("cameras", "v4l2"),
    "Options of `aravis`": ("cameras", "aravis"),
    "Simulation": ("simulation",),
}
"""Headings, and where their keys stand in the schema of a configuration: a key, a driver of it."""
AXES_ALIKE = "tilt."
AUTHORS = (
    "watchdog_s",
    "lease_s",
    "pan.settle_rad",
    "pan.current_limit_A",
    "cameras.seed",
    "scene.seed",
    "state.folder",
)
"""Default and bound of these hang on other values."""


def generated(text: str) -> str:
    """Return the page with the cells that the schemas fill."""
    config = schema_of("config")
    for heading, place in TABLES.items():
        before, mark, rest = text.partition(f"\n## {heading}\n")
        section, end, after = rest.partition("\n## ")
        schema = _at(config, place)
        lines = [_row(line, schema) if line.startswith("| `") else line for line in section.split("\n")]
        text = f"{before}{mark}{chr(10).join(lines)}{end}{after}"
    return text


def missing(text: str) -> list[str]:
    """Return the keys that the schemas have and the page has not, by heading."""
    config = schema_of("config")
    found = []
    for heading, place in TABLES.items():
        section = text.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
        cells = re.findall(r"^\| (`.*?) \|", section, re.MULTILINE)
        told = {key for cell in cells for key in re.findall(r"`([^`]+)`", cell)}
        for key in _keys(_at(config, place)):
            if key not in told and not key.startswith(AXES_ALIKE) and not _covered(key, told):
                found.append(f"{heading}: {key}")
    return found


def _covered(key: str, told: set[str]) -> bool:
    """Whether the page has what stands below a key, or tells a mapping in one row."""
    return any(other.startswith(f"{key}.") or key.startswith(f"{other}.") for other in told)


def _at(config: Schema, place: tuple[str, ...]) -> Schema:
    """The schema of a table."""
    if not place:
        return config
    here: Schema = config["properties"][place[0]]
    here = here.get("additionalProperties", here) if place[0] == "cameras" else here
    if len(place) == 1:
        return here
    case = next(one for one in here["allOf"] if one["if"]["properties"]["driver"]["const"] == place[1])
    options: Schema = case["then"]["properties"]["options"]
    return options


def _keys(schema: Schema, before: str = "") -> Iterator[str]:
    """Every key path of a mapping; names of one's own are left out."""
    for key, one in mapping_in(schema).get("properties", {}).items():
        yield before + key
        yield from _keys(one, f"{before}{key}.")


def _row(line: str, schema: Schema) -> str:
    """One row with its generated cells."""
    cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
    keys = re.findall(r"`([^`]+)`", cells[0])
    found = [_found(schema, key) for key in keys]
    if keys[0] in AUTHORS:
        return line
    for column, made in ((2, _default), (3, _bound)):
        told = {made(one, needed) for one, needed in found}
        if len(told) == 1 and (cell := told.pop()):
            cells[column] = _kept(cells[column], cell)
    return f"| {' | '.join(cells)} |".replace("|  |", "| |")


def _found(schema: Schema, path: str) -> tuple[Schema, bool]:
    """The schema of a key path, and whether the key is needed. Raises KeyError for a key that is no more."""
    needed = False
    for step in path.split("."):
        if step in NAMES:
            schema, needed = schema["additionalProperties"], False
            continue
        schema = mapping_in(schema)
        needed = step in schema.get("required", ())
        schema = schema["properties"][step]
    return schema, needed


def _default(schema: Schema, needed: bool) -> str:
    if needed:
        return "needed"
    value: Any = schema.get("default")
    if value is None or value == "" or isinstance(value, (dict, str)):
        return value if isinstance(value, str) else ""
    return json.dumps(value) if not isinstance(value, float) else _number(value, whole=False)


def _bound(schema: Schema, needed: bool) -> str:
    low, high = schema.get("minimum"), schema.get("maximum")
    above = schema.get("exclusiveMinimum")
    if above is not None and high is not None:
        return f"above {above:g}, up to {_number(high)}"
    if low is None or high is None or abs(low) >= 1e9 or (abs(high) >= 2**31 - 1 and abs(low) >= 2**31 - 1):
        return ""
    return f"{_number(low)} to {_number(high)}"


def _number(value: float, whole: bool = True) -> str:
    """A bound or default as a person writes it."""
    if math.isclose(abs(value), math.pi / 2):
        return f"{'-' if value < 0 else ''}π/2"
    if whole and float(value).is_integer():
        return str(int(value))
    return np.format_float_positional(value if not whole else float(f"{value:.5g}"), trim="0")


def _kept(cell: str, made: str) -> str:
    """The generated words, and what the author says behind them."""
    rest = cell.removeprefix(made)
    return cell if cell.startswith(made) and (not rest or rest[0] in ",;( ") else made
