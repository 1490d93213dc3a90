"""What simulated heads are made of: presets, the keys of ``simulation.head``, a true rig's own errors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from calib.geometry.rig import JointErrors
from drivers.errors import BadOptions
from drivers.faults import nearest
from drivers.options import is_number
from drivers.sim.axis import AxisSettings

ZERO_ALLOWED = ("backlash_rad", "approach_rad", "sag_rad")
_TILT_ONLY = ("sag_rad", "gravity_turnover_rad", "gravity_friction")
BOUNDS: Mapping[str, tuple[float, float]] = {
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


ARCSEC = math.radians(1 / 3600)


_SAG_RAD = 5e-5  # the 0.05 mrad, which the mast file does not know

# FLIR PTU-D46-70 in eighth steps of 11.57 arcsec, a quarter of its 46.29 arcsec half step (derived from the
# manuals of its sisters; the vendor markets 0.003°). Backlash 0.01° is the demo's choice. Ranges (±159°;
# -80°..+31°), 60°/s and 60°/s² are assumed.
_PTU = AxisSettings(
    count_rad=11.57 * ARCSEC,
    backlash_rad=math.radians(0.01),
    low_rad=math.radians(-159),
    high_rad=math.radians(159),
    speed_rad_per_s=math.radians(60),
    acceleration_rad_per_s2=math.radians(60),
    approach_rad=math.radians(0.1),
)
# Dynamixel X: 4096 counts a turn (0.0879°), 15' = 0.25° backlash (vendor's figure for XM/XH430 and 540).
# Speed and acceleration are assumed: well under the no-load speed, profile set by the driver.
_X = AxisSettings(
    count_rad=math.tau / 4096,
    backlash_rad=math.radians(0.25),
    low_rad=-math.pi,
    high_rad=math.pi,
    speed_rad_per_s=1.5,
    acceleration_rad_per_s2=4.0,
)

_PH42 = replace(
    _X, count_rad=math.tau / 607500, backlash_rad=math.radians(0.1), approach_rad=math.radians(0.3)
)


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
    low, high = BOUNDS.get(name, (0.0, math.inf))
    if name in BOUNDS:
        if not is_number(value) or not low <= value <= high:
            raise BadOptions(
                f"simulation.head.{name} is {value!r}, expected a number from {low:g} to {high:g}"
            )
        return float(value)
    if not is_number(value) or value < 0 or (value == 0 and name not in ZERO_ALLOWED):
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


@dataclass(frozen=True)
class HeadModel:
    """A head: its name and two axes."""

    name: str
    pan: AxisSettings
    tilt: AxisSettings


PRESETS: Mapping[str, HeadModel] = {
    "ptu_d46_70": HeadModel(
        "ptu_d46_70",
        _PTU,
        replace(_PTU, low_rad=math.radians(-80), high_rad=math.radians(31), sag_rad=_SAG_RAD),
    ),
    # The shortest way, not one-sided: the table shows what counts and backlash allow untreated.
    "dynamixel_x": HeadModel(
        "dynamixel_x", _X, replace(_X, low_rad=-math.pi / 2, high_rad=math.pi / 2, sag_rad=_SAG_RAD)
    ),
    # Dynamixel PH42: counts on the motor's side (607500 a turn of the output), so the backlash (6', vendor)
    # is what matters, and it is taken up. Speed and acceleration are assumed, as for the X.
    "ph42": HeadModel(
        "ph42", _PH42, replace(_PH42, low_rad=-math.pi / 2, high_rad=math.pi / 2, sag_rad=_SAG_RAD)
    ),
}


def head_settings(value: Any) -> HeadModel:
    """Return the head that a configuration names.

    Raises BadOptions for an unknown preset or key, a value that is not a number of the right sign or within
    its bounds, or values that do not go together.

    Parameters
    ----------
    value
        A preset's name, or a mapping with ``preset`` and any of ``count_rad``, ``backlash_rad``,
        ``approach_rad``, ``speed_rad_per_s``, ``acceleration_rad_per_s2``, ``ring_hz``, ``ring_damping``,
        ``ring_gain``, ``settle_s`` (both axes), ``sag_rad``, ``gravity_turnover_rad``, ``gravity_friction``
        (tilt), ``pan_harmonics_rad`` and ``tilt_harmonics_rad``.
    """
    changes = dict(value) if isinstance(value, Mapping) else {"preset": value}
    preset = changes.pop("preset", "ptu_d46_70")
    if not isinstance(preset, str) or preset not in PRESETS:
        raise BadOptions(f"simulation.head: there is no head {preset!r}{nearest(preset, PRESETS)}")
    pan, tilt = axis_changes(changes)
    head = PRESETS[preset]
    head = replace(head, pan=replace(head.pan, **pan), tilt=replace(head.tilt, **tilt))
    for axis in (head.pan, head.tilt):
        check_together(axis)
    return head


def with_joints(head: HeadModel, joints: JointErrors) -> HeadModel:
    """Return a head whose encoders and gears err as a true rig's ``joints`` say; the same if they read true.

    Raises BadOptions if the head has errors of its encoders already, or comes to its goals over less than the
    play.
    """
    if joints.reads_true:
        return head
    if head.pan.harmonics_rad or head.tilt.harmonics_rad:
        raise BadOptions(
            "simulation.head has harmonics, and the true rig's joints say what encoders are wrong by too; "
            "expected one of them"
        )
    pan, tilt = (
        replace(axis, harmonics_rad=joint.harmonics_rad, backlash_rad=joint.backlash_rad)
        for axis, joint in ((head.pan, joints.pan), (head.tilt, joints.tilt))
    )
    for axis in (pan, tilt):
        check_together(axis)
    return replace(head, pan=pan, tilt=tilt)
