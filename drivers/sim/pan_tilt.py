"""The simulated pan/tilt head in memory: what it is made of, and its calls; ``drivers.sim.axis`` moves it."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from calib.geometry.rig import JointErrors
from drivers.clock import Clock
from drivers.errors import BadOptions, BadReply, DriverError, NoReply
from drivers.faults import PAN_TILT, Fault, FaultPanel, nearest
from drivers.interfaces import AxisMotion, Reading
from drivers.sim.axis import AxisSettings
from drivers.sim.head_options import axis_changes, check_together
from drivers.sim.wire.axis import WireAxis

_T = TypeVar("_T")

ARCSEC = math.radians(1 / 3600)

REPLY_TIMEOUT_S = 0.1
"""How long a caller waits for a head that does not answer, seconds."""

LOWEST_SUPPLY = 0.8
"""Fraction of the nominal voltage under which the head complains: 9.5 V of 12 V, a Dynamixel X's default."""

HOTTEST_C = 80.0
"""Temperature over which the head complains, degrees Celsius: a Dynamixel X's default."""


@dataclass(frozen=True)
class HeadSettings:
    """A head: its name and two axes."""

    name: str
    pan: AxisSettings
    tilt: AxisSettings


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

PRESETS: Mapping[str, HeadSettings] = {
    "ptu_d46_70": HeadSettings(
        "ptu_d46_70",
        _PTU,
        replace(_PTU, low_rad=math.radians(-80), high_rad=math.radians(31), sag_rad=_SAG_RAD),
    ),
    # The shortest way, not one-sided: the table shows what counts and backlash allow untreated.
    "dynamixel_x": HeadSettings(
        "dynamixel_x", _X, replace(_X, low_rad=-math.pi / 2, high_rad=math.pi / 2, sag_rad=_SAG_RAD)
    ),
    # Dynamixel PH42: counts on the motor's side (607500 a turn of the output), so the backlash (6', vendor)
    # is what matters, and it is taken up. Speed and acceleration are assumed, as for the X.
    "ph42": HeadSettings(
        "ph42", _PH42, replace(_PH42, low_rad=-math.pi / 2, high_rad=math.pi / 2, sag_rad=_SAG_RAD)
    ),
}


def head_settings(value: Any) -> HeadSettings:
    """Return the head that a configuration names.

    Parameters
    ----------
    value
        A preset's name, or a mapping with ``preset`` and any of ``count_rad``, ``backlash_rad``,
        ``approach_rad``, ``speed_rad_per_s``, ``acceleration_rad_per_s2``, ``ring_hz``, ``ring_damping``,
        ``ring_gain``, ``settle_s`` (both axes), ``sag_rad``, ``gravity_turnover_rad``, ``gravity_friction``
        (tilt), ``pan_harmonics_rad`` and ``tilt_harmonics_rad``.

    Raises
    ------
    BadOptions
        For an unknown preset or key, a value that is not a number of the right sign or within its bounds, or
        values that do not go together.
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


def with_joints(head: HeadSettings, joints: JointErrors) -> HeadSettings:
    """Return a head whose encoders and gears err as a true rig's ``joints`` say; the same if they read true.

    Raises
    ------
    BadOptions
        If the head has errors of its encoders already, or comes to its goals over less than the play.
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


class SimulatedPanTilt:
    """A head in memory that fulfils ``drivers.interfaces.PanTilt``; safe from any thread.

    A new goal while under way replaces the old one without a jump in position or velocity.

    Parameters
    ----------
    head
        What it is made of.
    clock
        The simulation's clock.
    faults
        The panel that is asked for faults of ``pan_tilt``; none when left out.
    """

    def __init__(self, head: HeadSettings, clock: Clock, faults: FaultPanel | None = None) -> None:
        self.head = head
        self._clock = clock
        self._faults = faults or FaultPanel(clock.now_s, ())
        self._lock = threading.RLock()
        now_s = clock.now_s()
        self._axes = (
            WireAxis(head.pan, self._faults, number=0, resumes=False, time_s=now_s),
            WireAxis(head.tilt, self._faults, number=1, resumes=False, time_s=now_s),
        )
        self._closed = False

    def read(self) -> Reading:
        """Return the motor-side angles in whole counts.

        Raises
        ------
        NoReply
            Under faults that keep the answer away, and after ``close``.
        BadReply
            Under faults that damage it.
        """
        return self._call(self._reading)

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        """Start towards the angles, rounded to counts, and return at once.

        ``speed_rad_per_s`` bounds each axis; left out, or above the axis's own, the axis's own holds.

        Raises
        ------
        DriverError
            For a goal outside the device's own range, or an angle or speed that is not a usable number;
            nothing moves then.
        NoReply, BadReply
            As ``read``.
        """
        axes = (("pan", self.head.pan, pan_rad), ("tilt", self.head.tilt, tilt_rad))
        for word, axis, goal in axes:
            if not axis.low_rad <= goal <= axis.high_rad:
                raise DriverError(
                    f"{word} {goal:.4f} rad is outside the device's own range "
                    f"{axis.low_rad:.4f} to {axis.high_rad:.4f} rad",
                    device=self.head.name,
                )
        speed = math.inf if speed_rad_per_s is None else speed_rad_per_s
        if not speed > 0:
            raise DriverError(
                f"speed {speed_rad_per_s} rad/s is not a positive number", device=self.head.name
            )

        def start(now_s: float) -> None:
            for axis, goal_rad in zip(self._axes, (pan_rad, tilt_rad), strict=True):
                axis.to_count(now_s, goal_rad, speed)

        self._call(start)

    def stop(self) -> None:
        """Brake both axes and hold where they come to rest. Raises NoReply and BadReply as ``read``."""
        self._call(self._halt)

    def close(self) -> None:
        """Stop and let go; further calls fail with NoReply."""
        with self._lock:
            if not self._closed:
                self._halt(self._clock.now_s())
            self._closed = True

    def axis_motion(self) -> Mapping[str, AxisMotion]:
        """Return how each axis moves, by its settings; with an approach it rises to every goal."""
        axes = {"pan": self.head.pan, "tilt": self.head.tilt}
        return {
            name: AxisMotion(
                axis.acceleration_rad_per_s2,
                axis.approach_rad,
                math.inf if axis.approach_rad > 0 else None,
                axis.count_rad,
            )
            for name, axis in axes.items()
        }

    def true_joints(self, time_s: float) -> tuple[float, float]:
        """Return the mechanical pan and tilt at a moment of the last minute, radians. Never fails."""
        with self._lock:
            now_s = self._clock.now_s()
            for axis in self._axes:
                axis.follow(now_s)
            pan, tilt = (axis.mechanical_rad(time_s) for axis in self._axes)
        return pan, tilt

    def _halt(self, now_s: float) -> None:
        for axis in self._axes:
            axis.halt(now_s)

    def _reading(self, now_s: float) -> Reading:
        """The reading of a moment, as a fault leaves it."""
        counts = []
        for axis in self._axes:
            count = axis.settings.count_rad
            counts.append(round(axis.angle_rad(now_s) / count) * count)
        moving = any(axis.under_way(now_s) or axis.settles(now_s) for axis in self._axes)
        stuck = self._faults.find(PAN_TILT, "stuck", now_s)
        if stuck is not None and not self._faults.find(PAN_TILT, "off", now_s):
            seized = all(axis.seized(now_s) for axis in self._axes)
            moving = stuck.number("moving") > 0 or (moving and not seized)
        if fault := self._faults.find(PAN_TILT, "garbage", now_s):
            counts = [self._absurd(fault) for _ in counts]
        counts = [
            math.nan if axis.no_number(now_s) else count
            for axis, count in zip(self._axes, counts, strict=True)
        ]
        return Reading(counts[0], counts[1], moving, now_s, tuple(self._complaints(now_s)))

    def _complaints(self, now_s: float) -> Iterator[str]:
        """What the head itself reports as wrong."""
        for name, axis in zip(("pan", "tilt"), self._axes, strict=True):
            if axis.pressing(now_s):
                yield f"{name}: overload"
            if axis.supply(now_s) < LOWEST_SUPPLY:
                yield f"{name}: input voltage {axis.supply(now_s):.0%} of what it should be"
            if axis.temperature_c(now_s) > HOTTEST_C:
                yield f"{name}: overheating, {axis.temperature_c(now_s):.0f} °C"

    def _absurd(self, fault: Fault) -> float:
        """One of the angles that a head full of garbage reports."""
        kind, value = self._faults.draw(fault), self._faults.draw(fault)
        if kind < 0.4:
            return math.nan
        return (2 * value - 1) * (1e6 if kind < 0.6 else math.pi)

    def _call(self, action: Callable[[float], _T]) -> _T:
        """Do what a caller asked, at the moment of the call; then let the answer fail if a fault says so."""
        faults, name = self._faults, self.head.name
        with self._lock:
            now_s = self._clock.now_s()
            for axis in self._axes:
                axis.follow(now_s)
            if self._closed:
                raise NoReply("it is closed", device=name)
            gone = faults.find(PAN_TILT, "hang_up", now_s)
            deaf = gone or faults.find(PAN_TILT, "off", now_s) or faults.strikes(PAN_TILT, now_s)
            if not deaf:
                result = action(now_s)
                silent = faults.takes(PAN_TILT, "mute", now_s) or faults.takes(PAN_TILT, "half", now_s)
                dead = any(axis.silent(now_s) for axis in self._axes)
                damaged = faults.takes(PAN_TILT, "corrupt", now_s) or faults.takes(PAN_TILT, "swapped", now_s)
                late = faults.find(PAN_TILT, "delayed", now_s) or faults.takes(PAN_TILT, "late", now_s)
        if gone:
            raise NoReply("the line is gone", device=name)
        wait_s = late.number("delay_s") if not deaf and late else 0.0
        if deaf or silent or dead or (late and late.word == "late" and wait_s > REPLY_TIMEOUT_S):
            self._clock.sleep(REPLY_TIMEOUT_S)
            raise NoReply(f"no answer within {REPLY_TIMEOUT_S:g} s", device=name)
        self._clock.sleep(wait_s)
        if damaged:
            raise BadReply(f"the answer was damaged ({damaged.word})", device=name)
        return result
