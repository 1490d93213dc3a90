"""One axis through time: motor in counts, encoder, play of the gears, sag, ringing, approach from one side.

Three angles are kept apart. The *motor* angle, as its encoder has it, follows a trapezoid profile to the
goal, rounded to the nearest count. The *reading* is that angle in whole counts, since the encoder sits on the
motor's side of the gears. The *mechanical* angle is what the cameras ride on: the motor's true angle, which
differs by the encoder's harmonics, through the backlash, less the sag of the tilt axis, and ringing. Only the
simulated cameras and the experiments see it.

Ringing: the load hangs on its motor through something elastic (mast, bearings, gears), so the angle x by
which it is ahead of the motor obeys

    x'' + 2 ζ ω x' + ω² x = -g a(t)

with the motor's acceleration a. A profile's acceleration is constant in pieces, so x is a sum of answers to
steps (and, where an axis seizes, to a jump in velocity), each in closed form. Neither the encoder nor the
play of the gears notices.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from drivers.sim.motion import Motion

Harmonics = Sequence[tuple[float, float]]
"""Cosine and sine parts, radians, of the first, second, ... harmonic over a turn."""

STILL_RAD = 1e-8
"""What is left of a step's answer below this is none: 3e-5 px at a focal length of 3441 px."""


def shaft_rad(read_rad: float, harmonics_rad: Harmonics) -> float:
    """Return where a shaft truly is whose encoder reads an angle.

    A disc that sits off its centre is wrong by the first harmonic, one that is oval by the second.
    """
    if not harmonics_rad:
        return read_rad
    once_round = cmath.exp(1j * read_rad)
    wave = 0j
    for cosine, sine in reversed(harmonics_rad):
        wave = (wave + complex(cosine, -sine)) * once_round
    return read_rad + wave.real


def load_after_rad(
    before_rad: float, to_rad: float, gap_rad: float, turnover_rad: float, friction: float
) -> float:
    """Return where the load ends when the shaft has turned one way from within the gap.

    Gravity pulls with sin(turnover - load) of its largest torque, downwards below the turnover. Beyond
    ``friction`` of it the load hangs on the flank that it is pulled to; within, it stays until a flank takes
    it along.

    Parameters
    ----------
    turnover_rad
        Load angle at which the centre of mass is straight above the axis.
    friction
        Part of the largest torque of gravity that friction holds; 1: all of it.
    """
    load = min(max(before_rad, to_rad - gap_rad / 2), to_rad + gap_rad / 2)
    if friction >= 1.0:
        return load
    torque = math.sin(turnover_rad - load)
    if abs(torque) <= friction:
        return load
    return to_rad - math.copysign(gap_rad / 2, torque)


@dataclass(frozen=True)
class AxisSettings:
    """One axis of a head.

    Attributes
    ----------
    count_rad
        One encoder count or motor step.
    approach_rad
        0: the shortest way. Positive: every goal is reached moving in the positive direction, over at least
        this distance, which has to be more than the backlash.
        The way round may pass ``low_rad`` by as much.
    sag_rad
        Drop of a level load under gravity; at tilt t it is sag·cos(t), downwards.
    gravity_turnover_rad, gravity_friction
        The angle at which the load's centre of mass is straight above the axis, and the part of gravity's
        largest torque that friction holds. 1: all; the load stays where it was left in the gap.
    harmonics_rad
        What the encoder is wrong by over a turn (`drivers.sim.axis`); empty: it reads true.
    ring_hz, ring_damping, ring_gain
        The mode that rings after a move: ω/2π (0: none), ζ between 0 and 1, and g, which is 1 if all of the
        load takes part, as on a motor that turns it through a spring.
    settle_s
        How long after it has come to rest the head in memory says that it moves.
    """

    count_rad: float
    backlash_rad: float
    low_rad: float
    high_rad: float
    speed_rad_per_s: float
    acceleration_rad_per_s2: float
    approach_rad: float = 0.0
    sag_rad: float = 0.0
    gravity_turnover_rad: float = math.pi / 2
    gravity_friction: float = 1.0
    harmonics_rad: tuple[tuple[float, float], ...] = ()
    ring_hz: float = 0.0
    ring_damping: float = 0.03
    ring_gain: float = 1.0
    settle_s: float = 0.0

    def load_after_rad(self, before_rad: float, motor_rad: float) -> float:
        """Where the load ends when the motor has gone one way to ``motor_rad`` from within the gap."""
        shaft = shaft_rad(motor_rad, self.harmonics_rad)
        return load_after_rad(
            before_rad, shaft, self.backlash_rad, self.gravity_turnover_rad, self.gravity_friction
        )


@dataclass(frozen=True)
class Axis:
    """One axis through time: the motor's motion, and the load's angle at the start of each leg."""

    settings: AxisSettings
    motion: Motion
    loads_rad: tuple[float, ...] = field(default=())

    @staticmethod
    def resting(settings: AxisSettings, time_s: float, motor_rad: float = 0.0) -> Axis:
        """At an angle, last moved in the positive direction."""
        load = settings.load_after_rad(-math.inf, motor_rad)
        return Axis(settings, Motion.at_rest(time_s, motor_rad), (load,))

    def load_rad(self, time_s: float) -> float:
        """The load's angle behind the backlash."""
        return self._load_on(self.motion, self.loads_rad, self.motion.leg_index(time_s), time_s)

    def _load_on(self, motion: Motion, loads_rad: Sequence[float], index: int, time_s: float) -> float:
        leg, load = motion.legs[index], loads_rad[index]
        if leg.turn_rad is not None and time_s >= leg.turn_s:
            load = self.settings.load_after_rad(load, leg.turn_rad)
        return self.settings.load_after_rad(load, leg.at(time_s)[0])

    def mechanical_rad(self, time_s: float) -> float:
        """What the cameras ride on."""
        load, s = self.load_rad(time_s), self.settings
        angle = load - s.sag_rad * math.cos(load)
        if s.ring_hz > 0:
            angle += self._ahead_rad(time_s)
        return angle

    def _ahead_rad(self, time_s: float) -> float:
        """By how much ringing puts the load ahead of where the gears put it."""
        s = self.settings
        omega = math.tau * s.ring_hz
        decay = s.ring_damping * omega
        damped = omega * math.sqrt(1 - s.ring_damping**2)
        left, acceleration = 0.0, 0.0
        for shock_s, shock_rad_per_s2, jump_rad_per_s in self.motion.shocks(time_s):
            step, acceleration = shock_rad_per_s2 - acceleration, shock_rad_per_s2
            by_step, by_jump = step / omega**2, jump_rad_per_s / damped
            envelope = math.exp(-decay * (time_s - shock_s))
            if s.ring_gain * (2 * abs(by_step) + abs(by_jump)) * envelope < STILL_RAD:
                continue
            phase = damped * (time_s - shock_s)
            swing = by_step * (math.cos(phase) + decay / damped * math.sin(phase))
            left += envelope * (swing - by_jump * math.sin(phase))
        return s.ring_gain * (left - acceleration / omega**2)

    def followed_by(self, motion: Motion, time_s: float) -> Axis:
        """With a motion that continues this one from ``time_s``; the load's state is carried over."""
        first, last = self.motion.kept(time_s), self.motion.leg_index(time_s)
        loads = list(self.loads_rad[first : last + 1])
        for index in range(len(loads), len(motion.legs)):
            loads.append(self._load_on(motion, loads, index - 1, motion.legs[index].start_s))
        return replace(self, motion=motion, loads_rad=tuple(loads))

    def moved(self, time_s: float, goal_rad: float, speed_rad_per_s: float, factor: float) -> Axis:
        """Commanded to a goal, rounded to the nearest count, by way of the approach if there is one.

        ``factor`` slows it down, and from rest also its acceleration: an axis under way brakes as ever.
        """
        s = self.settings
        goal = round(goal_rad / s.count_rad) * s.count_rad
        position, velocity = self.motion.at(time_s)
        acceleration = s.acceleration_rad_per_s2 * (1.0 if velocity else factor)
        goals = [goal]
        if s.approach_rad > 0 and not (position == goal and velocity == 0):
            stop_rad = position + velocity * abs(velocity) / (2 * acceleration)
            if max(position, stop_rad) > goal - s.approach_rad:
                goals = [goal - s.approach_rad, goal]
        speed = factor * min(speed_rad_per_s, s.speed_rad_per_s)
        motion = self.motion.moved(time_s, goals, speed, acceleration)
        return self.followed_by(motion, time_s)
