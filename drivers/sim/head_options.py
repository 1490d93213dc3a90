"""The keys of ``simulation.head``: which axis each is for, and what it may be."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from drivers.errors import BadOptions
from drivers.faults import nearest
from drivers.options import is_number
from drivers.sim.axis import AxisSettings

_TILT_ONLY = ("sag_rad", "gravity_turnover_rad", "gravity_friction")
_BOUNDS: Mapping[str, tuple[float, float]] = {
    "gravity_turnover_rad": (-math.pi, math.pi),
    "gravity_friction": (0.0, 1.0),
    "ring_hz": (0.0, 100.0),
    "ring_damping": (0.001, 0.9),
    "ring_gain": (0.0, 10.0),
    "settle_s": (0.0, 5.0),
}
HEAD_KEYS = frozenset(
    {f.name for f in fields(AxisSettings)} - {"low_rad", "high_rad", "harmonics_rad"}
    | {"pan_harmonics_rad", "tilt_harmonics_rad"}
)
SLOWEST_DECAY_PER_S = 0.3
"""Ringing has to be over before the minute that an axis remembers is."""

MOST_HARMONICS, HARMONIC_RAD = 4, 0.05


def axis_changes(values: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what ``simulation.head`` changes in pan and in tilt. Raises BadOptions."""
    pan: dict[str, Any] = {}
    tilt: dict[str, Any] = {}
    for name, value in values.items():
        if name not in HEAD_KEYS:
            raise BadOptions(f"simulation.head has no key {name!r}{nearest(str(name), HEAD_KEYS)}")
        if name.endswith("harmonics_rad"):
            (pan if name.startswith("pan") else tilt)["harmonics_rad"] = _harmonics(name, value)
            continue
        number = _number(name, value)
        tilt[name] = number
        if name not in _TILT_ONLY:
            pan[name] = number
    return pan, tilt


def _number(name: str, value: Any) -> float:
    """A number of the head, within its bounds."""
    low, high = _BOUNDS.get(name, (0.0, math.inf))
    if name in _BOUNDS:
        if not is_number(value) or not low <= value <= high:
            raise BadOptions(
                f"simulation.head.{name} is {value!r}, expected a number from {low:g} to {high:g}"
            )
        return float(value)
    zero_allowed = name in ("backlash_rad", "approach_rad", "sag_rad")
    if not is_number(value) or value < 0 or (value == 0 and not zero_allowed):
        raise BadOptions(f"simulation.head.{name} is {value!r}, expected a positive number")
    return float(value)


def _harmonics(name: str, value: Any) -> tuple[tuple[float, float], ...]:
    """Cosine and sine parts of the first harmonics."""
    expected = f"expected up to {MOST_HARMONICS} pairs [cosine, sine], each part within {HARMONIC_RAD:g} rad"
    if not isinstance(value, list | tuple) or len(value) > MOST_HARMONICS:
        raise BadOptions(f"simulation.head.{name} is {value!r}, {expected}")
    for pair in value:
        if not isinstance(pair, list | tuple) or len(pair) != 2:
            raise BadOptions(f"simulation.head.{name} holds {pair!r}, {expected}")
        for part in pair:
            if not is_number(part) or abs(part) > HARMONIC_RAD:
                raise BadOptions(f"simulation.head.{name} holds {part!r}, {expected}")
    return tuple((float(cosine), float(sine)) for cosine, sine in value)


def check_together(axis: AxisSettings) -> None:
    """Pass an axis whose values go together. Raises BadOptions."""
    if 0 < axis.approach_rad <= axis.backlash_rad:
        raise BadOptions(
            f"simulation.head.approach_rad {axis.approach_rad:g} rad does not take up the backlash "
            f"{axis.backlash_rad:g} rad; expected more"
        )
    per_s = axis.ring_damping * math.tau * axis.ring_hz
    if 0 < per_s < SLOWEST_DECAY_PER_S:
        raise BadOptions(
            f"simulation.head.ring_damping {axis.ring_damping:g} at ring_hz {axis.ring_hz:g} rings for "
            f"minutes; expected at least {SLOWEST_DECAY_PER_S / (math.tau * axis.ring_hz):.2g}"
        )
    if axis.gravity_friction < 1:
        apart = math.pi - math.asin(axis.gravity_friction) - axis.backlash_rad
        lowest, highest = axis.high_rad - apart, axis.low_rad + apart
        if not lowest <= axis.gravity_turnover_rad <= highest:
            raise BadOptions(
                f"simulation.head.gravity_turnover_rad {axis.gravity_turnover_rad:g}: within the tilt range "
                f"the load would hang straight below the axis; expected {lowest:.2f} to {highest:.2f}"
            )
