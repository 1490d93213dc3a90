"""What simulated heads are made of: presets, the keys of ``simulation.head``, a true rig's own errors.

Behind ``simulation.wire`` stands a byte simulator; `WIRED_HEADS` says of which model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any

from pydantic import Field

from calib.geometry.rig import JointErrors
from drivers.errors import BadOptions
from drivers.options import DriverOptions, one_of, read_options
from drivers.sim.axis import AxisSettings

SLOWEST_DECAY_PER_S = 0.3
"""Ringing has to be over before the minute that an axis remembers is."""

MOST_HARMONICS, HARMONIC_RAD = 4, 0.05
PRESET_NAMES = ("ptu_d46_70", "dynamixel_x", "ph42")
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


_Length = Annotated[float, Field(ge=0.0, le=1e3)]
_Positive = Annotated[float, Field(gt=0.0, le=1e6)]
_Part = Annotated[float, Field(ge=-HARMONIC_RAD, le=HARMONIC_RAD)]
_Harmonics = Annotated[
    list[Annotated[list[_Part], Field(min_length=2, max_length=2)]], Field(max_length=MOST_HARMONICS)
]
_TILT_ONLY = ("sag_rad", "gravity_turnover_rad", "gravity_friction")


class HeadOptions(DriverOptions):
    """What a configuration changes in a preset: fields of `AxisSettings`, and what the encoders are wrong
    by."""

    preset: Annotated[str, one_of(PRESET_NAMES)] = PRESET_NAMES[0]
    count_rad: _Positive | None = None
    speed_rad_per_s: _Positive | None = None
    acceleration_rad_per_s2: _Positive | None = None
    backlash_rad: _Length | None = None
    approach_rad: _Length | None = None
    sag_rad: _Length | None = None
    gravity_turnover_rad: Annotated[float, Field(ge=-math.pi, le=math.pi)] | None = None
    gravity_friction: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    ring_hz: Annotated[float, Field(ge=0.0, le=100.0)] | None = None
    ring_damping: Annotated[float, Field(ge=0.001, le=0.9)] | None = None
    ring_gain: Annotated[float, Field(ge=0.0, le=10.0)] | None = None
    settle_s: Annotated[float, Field(ge=0.0, le=5.0)] | None = None
    pan_harmonics_rad: _Harmonics | None = None
    tilt_harmonics_rad: _Harmonics | None = None

    def changes(self, axis: str) -> dict[str, Any]:
        """Return what changes in the settings of ``pan`` or ``tilt``."""
        given = self.model_dump(
            exclude={"preset", "pan_harmonics_rad", "tilt_harmonics_rad"}, exclude_none=True
        )
        found = {name: value for name, value in given.items() if axis == "tilt" or name not in _TILT_ONLY}
        harmonics = self.pan_harmonics_rad if axis == "pan" else self.tilt_harmonics_rad
        if harmonics is not None:
            found["harmonics_rad"] = tuple((cosine, sine) for cosine, sine in harmonics)
        return found


def check_together(axis: AxisSettings) -> None:
    """Raise BadOptions for an axis whose values do not go together."""
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


@dataclass(frozen=True)
class WireModel:
    """What stands behind a preset's wire: the simulator's model, and the driver's name for it."""

    wire: str
    simulated: str
    driver_model: str = ""


WIRED_HEADS: Mapping[str, WireModel] = {
    "dynamixel_x": WireModel("dynamixel", "xm430_w350", "XM430-W350"),
    "ph42": WireModel("dynamixel", "ph42_020_s300", "PH42-020-S300"),
    "ptu_d46_70": WireModel("flir_ptu", "d46_70"),
}

DEFAULT_HEADS: Mapping[str, str] = {"dynamixel": "dynamixel_x", "flir_ptu": "ptu_d46_70"}
"""The wires there are, and the head behind each where a configuration names none."""


def check_head(wire: str, head: HeadModel) -> None:
    """Raise BadOptions, naming those that can, for a head that cannot stand behind a wire."""
    fitting = [name for name, one in WIRED_HEADS.items() if one.wire == wire]
    if head.name not in fitting:
        raise BadOptions(
            f"simulation.head is {head.name!r}, which is not behind simulation.wire {wire!r}; "
            f"expected {' or '.join(fitting)}"
        )
    preset = PRESETS[head.name]
    if head.pan.count_rad != preset.pan.count_rad or head.tilt.count_rad != preset.tilt.count_rad:
        raise BadOptions(
            f"simulation.head.count_rad cannot be changed behind simulation.wire {wire!r}: the device has it"
        )


def head_settings(value: Any) -> HeadModel:
    """Return the head that a configuration names.

    Raises BadOptions for a key or value that cannot be, or values that do not go together. ``value`` is a
    preset's name, or a mapping (`HeadOptions`).
    """
    changed = read_options(
        HeadOptions, value if isinstance(value, Mapping) else {"preset": value}, place="simulation.head"
    )
    head = PRESETS[changed.preset]
    pan, tilt = (replace(getattr(head, axis), **changed.changes(axis)) for axis in ("pan", "tilt"))
    head = replace(head, pan=pan, tilt=tilt)
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
