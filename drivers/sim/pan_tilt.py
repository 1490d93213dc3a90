"""The simulated pan/tilt head: encoder counts, backlash, sag, and approach from one side.

Three angles are kept apart. The *motor* angle follows a trapezoid profile to the goal, rounded to the
nearest count. The *reading* is the motor angle in whole counts, since the encoder sits on the motor's side
of the gears. The *mechanical* angle is what the cameras ride on: the motor angle through the backlash,
less the sag of the tilt axis. Only the simulated cameras and the experiments see it.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

from drivers.clock import Clock
from drivers.errors import BadOptions, DriverError, NoReply
from drivers.faults import PAN_TILT, Fault, FaultPanel, nearest
from drivers.interfaces import Reading
from drivers.sim.motion import Motion

_T = TypeVar("_T")

ARCSEC = math.radians(1 / 3600)

REPLY_TIMEOUT_S = 0.1
"""How long a caller waits for a head that does not answer, seconds."""


@dataclass(frozen=True)
class AxisSettings:
    """One axis of a head.

    Attributes
    ----------
    count_rad
        One encoder count or motor step.
    backlash_rad
        Full width of the gap between motor and load.
    low_rad, high_rad
        Goals that the device accepts.
    speed_rad_per_s, acceleration_rad_per_s2
        Largest speed, and the acceleration of every move.
    approach_rad
        0: the shortest way. Positive: every goal is reached moving in the positive direction, over at least
        this distance, which has to be more than the backlash.
        The way round may pass ``low_rad`` by as much.
    sag_rad
        Drop of a level load under gravity; at tilt t it is sag·cos(t), downwards.
    """

    count_rad: float
    backlash_rad: float
    low_rad: float
    high_rad: float
    speed_rad_per_s: float
    acceleration_rad_per_s2: float
    approach_rad: float = 0.0
    sag_rad: float = 0.0


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
}


def head_settings(value: Any) -> HeadSettings:
    """Return the head that a configuration names.

    Parameters
    ----------
    value
        A preset's name, or a mapping with ``preset`` and any of ``count_rad``, ``backlash_rad``,
        ``approach_rad``, ``speed_rad_per_s``, ``acceleration_rad_per_s2`` (both axes) and ``sag_rad`` (tilt).

    Raises
    ------
    BadOptions
        For an unknown preset or key, or a value that is not a number of the right sign.
    """
    changes = dict(value) if isinstance(value, Mapping) else {"preset": value}
    preset = changes.pop("preset", "ptu_d46_70")
    if not isinstance(preset, str) or preset not in PRESETS:
        raise BadOptions(f"simulation.head: there is no head {preset!r}{nearest(preset, PRESETS)}")
    head = PRESETS[preset]
    known = {f.name for f in fields(AxisSettings)} - {"low_rad", "high_rad"}
    for name, number in changes.items():
        if name not in known:
            raise BadOptions(f"simulation.head has no key {name!r}{nearest(name, known)}")
        zero_allowed = name in ("backlash_rad", "approach_rad", "sag_rad")
        good = isinstance(number, int | float) and not isinstance(number, bool) and math.isfinite(number)
        if not good or number < 0 or (number == 0 and not zero_allowed):
            raise BadOptions(f"simulation.head.{name} is {number!r}, expected a positive number")
        if name != "sag_rad":
            head = replace(head, pan=replace(head.pan, **{name: float(number)}))
        head = replace(head, tilt=replace(head.tilt, **{name: float(number)}))
    for axis in (head.pan, head.tilt):
        if 0 < axis.approach_rad <= axis.backlash_rad:
            raise BadOptions(
                f"simulation.head.approach_rad {axis.approach_rad:g} rad does not take up the backlash "
                f"{axis.backlash_rad:g} rad; expected more"
            )
    return head


def _play(load_rad: float, motor_rad: float, gap_rad: float) -> float:
    """Where the load ends when the motor has gone one way to ``motor_rad`` from within the gap."""
    return min(max(load_rad, motor_rad - gap_rad / 2), motor_rad + gap_rad / 2)


@dataclass(frozen=True)
class Axis:
    """One axis through time: the motor's motion, and the load's angle at the start of each leg."""

    settings: AxisSettings
    motion: Motion
    loads_rad: tuple[float, ...] = field(default=())

    @staticmethod
    def resting(settings: AxisSettings, time_s: float) -> Axis:
        """At zero, last moved in the positive direction."""
        return Axis(settings, Motion.at_rest(time_s, 0.0), (-settings.backlash_rad / 2,))

    def load_rad(self, time_s: float) -> float:
        """The load's angle behind the backlash."""
        return self._load_on(self.motion, self.loads_rad, self.motion.leg_index(time_s), time_s)

    def _load_on(self, motion: Motion, loads_rad: Sequence[float], index: int, time_s: float) -> float:
        leg, load, gap = motion.legs[index], loads_rad[index], self.settings.backlash_rad
        if leg.turn_rad is not None and time_s >= leg.turn_s:
            load = _play(load, leg.turn_rad, gap)
        return _play(load, leg.at(time_s)[0], gap)

    def mechanical_rad(self, time_s: float) -> float:
        """What the cameras ride on."""
        load = self.load_rad(time_s)
        return load - self.settings.sag_rad * math.cos(load)

    def followed_by(self, motion: Motion, time_s: float) -> Axis:
        """With a motion that continues this one from ``time_s``; the load's state is carried over."""
        first, last = self.motion.kept(time_s), self.motion.leg_index(time_s)
        loads = list(self.loads_rad[first : last + 1])
        for index in range(len(loads), len(motion.legs)):
            loads.append(self._load_on(motion, loads, index - 1, motion.legs[index].start_s))
        return replace(self, motion=motion, loads_rad=tuple(loads))

    def moved(self, time_s: float, goal_rad: float, speed_rad_per_s: float, factor: float) -> Axis:
        """Commanded to a goal, rounded to the nearest count, by way of the approach if there is one."""
        s = self.settings
        goal = round(goal_rad / s.count_rad) * s.count_rad
        position, velocity = self.motion.at(time_s)
        goals = [goal]
        if s.approach_rad > 0 and not (position == goal and velocity == 0):
            stop_rad = position + velocity * abs(velocity) / (2 * factor * s.acceleration_rad_per_s2)
            if max(position, stop_rad) > goal - s.approach_rad:
                goals = [goal - s.approach_rad, goal]
        speed = factor * min(speed_rad_per_s, s.speed_rad_per_s)
        motion = self.motion.moved(time_s, goals, speed, factor * s.acceleration_rad_per_s2)
        return self.followed_by(motion, time_s)


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
        self._axes = (Axis.resting(head.pan, now_s), Axis.resting(head.tilt, now_s))
        self._command: tuple[float, float, float] | None = None
        self._jam: Fault | None = None
        self._factor = 1.0
        self._closed = False

    def read(self) -> Reading:
        """Return the motor-side angles in whole counts.

        Raises
        ------
        NoReply
            Under the faults ``off`` and ``intermittent``, and after ``close``.
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
        NoReply
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
            if self._jam is None:
                self._command = (pan_rad, tilt_rad, speed)
                self._drive(now_s)

        self._call(start)

    def stop(self) -> None:
        """Brake both axes and hold where they come to rest. Raises NoReply as ``read``."""
        self._call(self._halt)

    def close(self) -> None:
        """Stop and let go; further calls fail with NoReply."""
        with self._lock:
            now_s = self._follow_faults()
            if not self._closed:
                self._halt(now_s)
            self._closed = True

    def true_joints(self, time_s: float) -> tuple[float, float]:
        """Return the mechanical pan and tilt at a moment of the last minute, radians. Never fails."""
        with self._lock:
            self._follow_faults()
            pan, tilt = self._axes
        return pan.mechanical_rad(time_s), tilt.mechanical_rad(time_s)

    def _halt(self, now_s: float) -> None:
        """Brake both axes; seized ones stand already."""
        if self._jam is not None:
            return
        self._command = None
        pan, tilt = (
            axis.followed_by(
                axis.motion.stopped(now_s, self._factor * axis.settings.acceleration_rad_per_s2), now_s
            )
            for axis in self._axes
        )
        self._axes = (pan, tilt)

    def _drive(self, now_s: float) -> None:
        """Send both axes to the command."""
        if self._command is None:
            return
        pan_rad, tilt_rad, speed = self._command
        pan, tilt = self._axes
        self._axes = (
            pan.moved(now_s, pan_rad, speed, self._factor),
            tilt.moved(now_s, tilt_rad, speed, self._factor),
        )

    def _reading(self, now_s: float) -> Reading:
        """The reading of a moment, as a fault leaves it."""
        counts = []
        for axis in self._axes:
            count = axis.settings.count_rad
            counts.append(round(axis.motion.at(now_s)[0] / count) * count)
        moving = any(now_s < axis.motion.end_s for axis in self._axes)
        if self._jam is not None and self._jam.word == "stuck":
            moving = self._jam.number("moving") > 0
        if fault := self._faults.find(PAN_TILT, "wrong", now_s):
            counts = [angle + fault.number("offset_rad") for angle in counts]
        if fault := self._faults.find(PAN_TILT, "garbage", now_s):
            counts = [self._absurd(fault) for _ in counts]
        return Reading(counts[0], counts[1], moving, now_s)

    def _absurd(self, fault: Fault) -> float:
        """One of the angles that a head full of garbage reports."""
        kind, value = self._faults.draw(fault), self._faults.draw(fault)
        if kind < 0.4:
            return math.nan
        return (2 * value - 1) * (1e6 if kind < 0.6 else math.pi)

    def _follow_faults(self) -> float:
        """Seize, free, slow down or speed up the axes as the panel says; return the time now."""
        now_s = self._clock.now_s()
        jam = self._faults.find(PAN_TILT, "off", now_s) or self._faults.find(PAN_TILT, "stuck", now_s)
        if jam is not None and self._jam is None:
            since_s = min(now_s, max(jam.begin_s, *(a.motion.legs[0].start_s for a in self._axes)))
            pan, tilt = (axis.followed_by(axis.motion.jammed(since_s), since_s) for axis in self._axes)
            self._axes, self._command = (pan, tilt), None
        self._jam = jam
        slow = self._faults.find(PAN_TILT, "slow", now_s)
        factor = slow.number("factor") if slow else 1.0
        if factor != self._factor:
            self._factor = factor
            if any(now_s < axis.motion.end_s for axis in self._axes):
                self._drive(now_s)
        return now_s

    def _call(self, action: Callable[[float], _T]) -> _T:
        """Do what a caller asked, at the moment of the call, unless the head does not answer."""
        with self._lock:
            now_s = self._follow_faults()
            closed = self._closed
            silent = self._faults.find(PAN_TILT, "off", now_s) or self._faults.strikes(PAN_TILT, now_s)
            late = self._faults.find(PAN_TILT, "delayed", now_s)
            if not closed and not silent:
                result = action(now_s)
        if closed:
            raise NoReply("it is closed", device=self.head.name)
        if silent:
            self._clock.sleep(REPLY_TIMEOUT_S)
            raise NoReply(f"no answer within {REPLY_TIMEOUT_S:g} s", device=self.head.name)
        if late:
            self._clock.sleep(late.number("delay_s"))
        return result
