"""One axis of a simulated head through time: motor in counts, encoder, gears, load, faults of the mechanism.

Three angles are kept apart. The *motor* angle, as its encoder has it, follows a trapezoid profile to the
goal. The *reading* is that angle in whole counts, since the encoder sits on the motor's side of the gears.
The *mechanical* angle is what the cameras ride on: the motor's true angle, which differs by the encoder's
harmonics, through the backlash, less the sag of the tilt axis, and ringing. Only the simulated cameras and
the experiments see it. Angles are those of the mast (positive pan right, positive tilt up).

Ringing: the load hangs on its motor through something elastic (mast, bearings, gears), so the angle x by
which it is ahead of the motor obeys

    x'' + 2 ζ ω x' + ω² x = -g a(t)

with the motor's acceleration a. A profile's acceleration is constant in pieces, so x is a sum of answers to
steps, each in closed form. Neither the encoder nor the play of the gears notices; that a fault seizes an axis
rings nothing.
"""

from __future__ import annotations

import cmath
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from drivers.faults import PAN_TILT, Fault, FaultPanel
from drivers.sim.motion import Motion

STILL_RAD = 1e-8
"""What is left of a step's answer below this is none: 3e-5 px at a focal length of 3441 px."""

WARM_C = 35.0
"""Temperature of a motor without a fault."""

HOTTEST_C = 125.0
"""Where a temperature ramp ends."""

_FASTEST_RAD_PER_S = 100.0
_STEEPEST_RAD_PER_S2 = 1e4


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
        largest torque that friction withstands. 1: all; the load stays where it was left in the gap.
    harmonics_rad
        What the encoder is wrong by over a turn: cosine and sine parts of the first, second, ... harmonic;
        empty: it reads true. A disc that sits off its centre is wrong by the first, one that is oval by the
        second.
    ring_hz, ring_damping, ring_gain
        The mode that rings after a move: ω/2π (0: none), ζ between 0 and 1, and g, which is 1 if all of the
        load takes part, as on a motor that turns it through a spring.
    settle_s
        How long after it has come to rest the head in memory reports that it moves.
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

    def shaft_rad(self, motor_rad: float) -> float:
        """Return where the shaft truly is whose encoder has the motor at an angle."""
        if not self.harmonics_rad:
            return motor_rad
        once_round = cmath.exp(1j * motor_rad)
        wave = 0j
        for cosine, sine in reversed(self.harmonics_rad):
            wave = (wave + complex(cosine, -sine)) * once_round
        return motor_rad + wave.real

    def load_after_rad(self, before_rad: float, motor_rad: float) -> float:
        """Return where the load ends when the motor has gone one way to ``motor_rad`` from within the gap.

        Gravity pulls with sin(turnover - load) of its largest torque, downwards below the turnover. Beyond
        the friction's part of it the load hangs on the flank that it is pulled to; within, it stays until a
        flank takes it along.
        """
        shaft, half_gap = self.shaft_rad(motor_rad), self.backlash_rad / 2
        load = min(max(before_rad, shaft - half_gap), shaft + half_gap)
        if self.gravity_friction >= 1.0:
            return load
        torque = math.sin(self.gravity_turnover_rad - load)
        if abs(torque) <= self.gravity_friction:
            return load
        return shaft - math.copysign(half_gap, torque)


class WireAxis:
    """An axis that takes orders at times that do not run backwards, and can be queried about the past minute.

    A head in memory or a byte simulator decides where the motor goes; counts, units and limits are theirs.
    Safe from any thread.

    The acceleration of ``settings`` is what ``halt`` brakes with. Counts, speed and approach are for
    ``to_count`` only; the range is not used here. ``number``, 0 for pan, 1 for tilt: which faults concern it.
    ``resumes``: whether it goes on to where it was sent when a fault that stopped it is over.
    """

    def __init__(
        self,
        settings: AxisSettings,
        faults: FaultPanel | None = None,
        *,
        number: Literal[0, 1] = 0,
        start_rad: float = 0.0,
        time_s: float = 0.0,
        resumes: bool = True,
    ) -> None:
        self.settings = settings
        self._faults = faults
        self._number = number
        self._resumes = resumes
        self._lock = threading.RLock()
        self._motion = Motion.at_rest(time_s, start_rad)
        # the load's angle at the start of each leg; at first as after a move in the positive direction
        self._loads_rad = [settings.load_after_rad(-math.inf, start_rad)]
        self._order: Callable[[float], Motion] | None = None  # what the motor tries; None: to stand still
        self._jammed = self._pressing = False  # seized; pushing against an obstacle
        self._factor = 1.0
        self._obstacle: tuple[Fault, float] | None = None  # and on which side of it the axis is, 1 or -1
        self._seen_s = time_s

    @property
    def motion(self) -> Motion:
        """The motor's motion as it is planned now."""
        return self._motion

    # Orders

    def goal(
        self, time_s: float, angle_rad: float, speed_rad_per_s: float, acceleration_rad_per_s2: float
    ) -> None:
        """Start towards an angle, in place of what it does; speed and acceleration are bounds above zero."""
        speed = min(speed_rad_per_s, _FASTEST_RAD_PER_S)
        self._take(time_s, angle_rad, speed, min(acceleration_rad_per_s2, _STEEPEST_RAD_PER_S2), 0.0)

    def to_count(self, time_s: float, angle_rad: float, speed_rad_per_s: float) -> None:
        """Start towards the nearest count, by way of the settings' approach and within their bounds."""
        s = self.settings
        goal_rad = round(angle_rad / s.count_rad) * s.count_rad
        speed = min(speed_rad_per_s, s.speed_rad_per_s)
        self._take(time_s, goal_rad, speed, s.acceleration_rad_per_s2, s.approach_rad)

    def halt(self, time_s: float, acceleration_rad_per_s2: float | None = None) -> None:
        """Brake and stay; also what friction does to an axis whose motor is let go."""
        with self._lock:
            self.follow(time_s)
            self._order = None
            self._pressing = False
            wanted = acceleration_rad_per_s2 or self.settings.acceleration_rad_per_s2
            if not self._jammed:
                self._continue(self._motion.stopped(time_s, min(wanted, _STEEPEST_RAD_PER_S2)), time_s)

    def _take(
        self, time_s: float, goal_rad: float, speed: float, acceleration: float, approach_rad: float
    ) -> None:
        """Go to a goal as far as faults allow; with an approach, from below."""

        def order(now_s: float) -> Motion:
            position, velocity = self._motion.at(now_s)
            # slow from rest only: an axis under way brakes as ever
            steepest = acceleration if velocity else self._factor * acceleration
            goals = [goal_rad]
            if approach_rad > 0 and not (position == goal_rad and velocity == 0):
                stop_rad = position + velocity * abs(velocity) / (2 * steepest)
                if max(position, stop_rad) > goal_rad - approach_rad:
                    goals = [goal_rad - approach_rad, goal_rad]
            return self._motion.moved(now_s, goals, self._factor * speed, steepest)

        with self._lock:
            self.follow(time_s)
            if self._jammed and not self._resumes:
                return
            self._order = order
            self._pressing = False
            if not self._jammed:
                self._continue(order(time_s), time_s)

    # What it does at a moment

    def angle_rad(self, time_s: float) -> float:
        """Return where the motor is as its encoder has it, with the encoder's faults."""
        angle_rad = self._at(time_s)[0]
        if fault := self._fault("wrong", time_s):
            angle_rad += fault.number("offset_rad")
        if fault := self._fault("drifting", time_s):
            angle_rad += fault.number("rate_rad_per_s") * (time_s - fault.begin_s)
        if (fault := self._fault("garbage", time_s)) and self._faults is not None:
            kind, value = self._faults.draw(fault), self._faults.draw(fault)
            angle_rad = (2 * value - 1) * (1e3 if kind < 0.5 else math.pi)
        return angle_rad

    def velocity_rad_per_s(self, time_s: float) -> float:
        """Return how fast the motor turns."""
        return self._at(time_s)[1]

    def mechanical_rad(self, time_s: float) -> float:
        """Return what the cameras ride on: the load behind the backlash, less the sag, ringing."""
        with self._lock:
            self.follow(time_s)
            motion = self._motion
            load = self._load_rad(motion, motion.leg_index(time_s), time_s)
        angle = load - self.settings.sag_rad * math.cos(load)
        if self.settings.ring_hz > 0:
            angle += self._ringing_rad(motion, time_s)
        return angle

    def under_way(self, time_s: float) -> bool:
        """Return whether the motor has not come to rest where it was sent."""
        self.follow(time_s)
        return time_s < self._motion.end_s

    def settles(self, time_s: float) -> bool:
        """Return whether the motor turns or did so within the settings' ``settle_s``."""
        self.follow(time_s)
        return time_s < self._motion.stood_since_s + self.settings.settle_s

    def end_s(self) -> float:
        """Return when the motor comes to rest, if nothing new happens."""
        return self._motion.end_s

    def rest_rad(self) -> float:
        """Return where the motor comes to rest, if nothing new happens."""
        motion = self._motion
        return motion.at(motion.end_s)[0]

    def silent(self, time_s: float) -> bool:
        """Return whether its servo is dead."""
        return self._fault("silent", time_s) is not None

    def no_number(self, time_s: float) -> bool:
        """Return whether its angle is reported as none, where a device can report that."""
        return self._fault("not_a_number", time_s) is not None

    def seized(self, time_s: float) -> bool:
        """Return whether the gears do not turn at all."""
        self.follow(time_s)
        return self._jammed

    def pressing(self, time_s: float) -> bool:
        """Return whether the motor pushes against an obstacle."""
        self.follow(time_s)
        return self._pressing

    def blocked(self, time_s: float) -> bool:
        """Return whether something keeps the motor from where it was sent."""
        with self._lock:
            self.follow(time_s)
            return self._order is not None and (self._jammed or self._pressing)

    def supply(self, time_s: float) -> float:
        """Return the supply voltage as a fraction of the nominal one."""
        fault = self._fault("voltage_dip", time_s)
        return fault.number("factor") if fault else 1.0

    def temperature_c(self, time_s: float) -> float:
        """Return the motor's temperature, degrees Celsius."""
        fault = self._fault("temperature_ramp", time_s)
        if fault is None:
            return WARM_C
        return min(HOTTEST_C, WARM_C + fault.number("rate_c_per_s") * (time_s - fault.begin_s))

    def follow(self, time_s: float) -> None:
        """Let faults act until a moment: seize, free, slow down, speed up, run against the obstacle.

        Every query of the axis does so too.
        """
        if self._faults is None:
            return
        with self._lock:
            if time_s < self._seen_s:
                return
            self._meet_obstacle(time_s)
            jam = self._fault("off", time_s) or self._fault("stuck", time_s) or self._fault("silent", time_s)
            if (jam is not None) != self._jammed:
                self._jammed = jam is not None
                if jam is not None:
                    self._stop_at(min(time_s, max(jam.begin_s, self._motion.legs[0].start_s)))
                elif self._order is not None:
                    self._continue(self._order(time_s), time_s)
            slow = self._fault("slow", time_s)
            factor = slow.number("factor") if slow else 1.0
            if factor != self._factor:
                self._factor = factor
                if self._order is not None and not self._jammed and time_s < self._motion.end_s:
                    self._continue(self._order(time_s), time_s)
            self._seen_s = time_s

    # Inside

    def _at(self, time_s: float) -> tuple[float, float]:
        """The motor's angle and velocity as faults leave them until a moment."""
        self.follow(time_s)
        return self._motion.at(time_s)

    def _load_rad(self, motion: Motion, index: int, time_s: float) -> float:
        """The load's angle behind the backlash at a moment of a leg."""
        leg, load = motion.legs[index], self._loads_rad[index]
        if leg.turn_rad is not None and time_s >= leg.turn_s:
            load = self.settings.load_after_rad(load, leg.turn_rad)
        return self.settings.load_after_rad(load, leg.at(time_s)[0])

    def _ringing_rad(self, motion: Motion, time_s: float) -> float:
        """By how much ringing puts the load ahead of where the gears put it."""
        s = self.settings
        omega = math.tau * s.ring_hz
        decay = s.ring_damping * omega
        damped = omega * math.sqrt(1 - s.ring_damping**2)
        left, acceleration = 0.0, 0.0
        for shock_s, shock_rad_per_s2 in motion.shocks(time_s):
            by_step = (shock_rad_per_s2 - acceleration) / omega**2
            acceleration = shock_rad_per_s2
            envelope = math.exp(-decay * (time_s - shock_s))
            if s.ring_gain * 2 * abs(by_step) * envelope < STILL_RAD:
                continue
            phase = damped * (time_s - shock_s)
            left += envelope * (by_step * (math.cos(phase) + decay / damped * math.sin(phase)))
        return s.ring_gain * (left - acceleration / omega**2)

    def _continue(self, motion: Motion, time_s: float) -> None:
        """Go on by another motion from a moment on; the load's state is carried over."""
        first, last = self._motion.kept(time_s), self._motion.leg_index(time_s)
        self._loads_rad = self._loads_rad[first : last + 1]
        for index in range(len(self._loads_rad), len(motion.legs)):
            self._loads_rad.append(self._load_rad(motion, index - 1, motion.legs[index].start_s))
        self._motion = motion

    def _stop_at(self, time_s: float) -> None:
        """Stop dead, and forget the order if it does not resume."""
        self._continue(self._motion.jammed(time_s), time_s)
        self._order = self._order if self._resumes else None

    def _fault(self, name: str, time_s: float) -> Fault | None:
        """The fault of this name if it concerns this axis now."""
        fault = self._faults.find(PAN_TILT, name, time_s) if self._faults is not None else None
        if fault is None or fault.parameters.get("axis", 2.0) not in (2.0, float(self._number)):
            return None
        return fault

    def _meet_obstacle(self, time_s: float) -> None:
        """Stop at the angle of an ``overload``, which is not to be passed while the fault lasts."""
        fault = self._fault("overload", time_s)
        if fault is None:
            self._obstacle = None
            if self._pressing and self._order is not None and not self._jammed:
                self._continue(self._order(time_s), time_s)
            self._pressing = False
            return
        at_rad = fault.number("angle_rad")
        if self._obstacle is None or self._obstacle[0] is not fault:
            since_s = max(fault.begin_s, min(self._seen_s, time_s))
            self._obstacle = fault, 1.0 if self._motion.at(since_s)[0] >= at_rad else -1.0
            self._seen_s = since_s
        side, motion = self._obstacle[1], self._motion
        if side * (motion.at(time_s)[0] - at_rad) >= 0:
            return
        low_s, high_s = self._seen_s, time_s  # on this side, beyond
        for _ in range(40):
            middle_s = (low_s + high_s) / 2
            if side * (motion.at(middle_s)[0] - at_rad) >= 0:
                low_s = middle_s
            else:
                high_s = middle_s
        self._stop_at(low_s)
        self._pressing = True
