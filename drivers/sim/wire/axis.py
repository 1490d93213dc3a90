"""One physical axis of a simulated head: motor, gears, load, and the faults of the mechanism.

A head in memory or a byte simulator says where the motor shall go and reads its encoder; the cameras ride on
the mechanical angle. Angles are those of the mast (positive pan right, positive tilt up). A byte simulator's
own counts, units and limits are left to it.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import Literal

from drivers.faults import PAN_TILT, Fault, FaultPanel
from drivers.sim.axis import Axis, AxisSettings
from drivers.sim.motion import Motion

WARM_C = 35.0
"""Temperature of a motor without a fault."""

HOTTEST_C = 125.0
"""Where a temperature ramp ends."""

_FASTEST_RAD_PER_S = 100.0
_STEEPEST_RAD_PER_S2 = 1e4


class WireAxis:
    """An axis that takes orders at times that do not run backwards, and can be queried about the past minute.

    Safe from any thread.

    Parameters
    ----------
    settings
        Encoder, backlash, sag and ringing; its acceleration is what ``halt`` brakes with. Counts, speed and
        approach are for ``to_count`` only; the range is not used here.
    number
        0 for pan, 1 for tilt: which faults concern it.
    resumes
        Whether it goes on to where it was sent when a fault that held it is over.
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
        self._axis = Axis.resting(settings, time_s, start_rad)
        self._order: Callable[[float], Motion] | None = None  # what the motor tries; None: to stand still
        self._jammed = self._pressing = False  # seized; pushing against an obstacle
        self._factor = 1.0
        self._obstacle: tuple[Fault, float] | None = None  # and on which side of it the axis is, 1 or -1
        self._seen_s = time_s

    @property
    def motion(self) -> Motion:
        """The motor's motion as it is planned now."""
        return self._axis.motion

    def goal(
        self, time_s: float, angle_rad: float, speed_rad_per_s: float, acceleration_rad_per_s2: float
    ) -> None:
        """Start towards an angle, in place of what it does; speed and acceleration are bounds above zero."""
        speed = min(speed_rad_per_s, _FASTEST_RAD_PER_S)
        acceleration = min(acceleration_rad_per_s2, _STEEPEST_RAD_PER_S2)

        def drive(now_s: float) -> Motion:
            motion, factor = self._axis.motion, self._factor
            steepest = acceleration if motion.at(now_s)[1] else factor * acceleration  # it brakes as ever
            return motion.moved(now_s, [angle_rad], factor * speed, steepest)

        self._take(time_s, drive)

    def to_count(self, time_s: float, angle_rad: float, speed_rad_per_s: float) -> None:
        """Start towards the nearest count, by way of the approach, with the settings' acceleration."""

        def drive(now_s: float) -> Motion:
            return self._axis.moved(now_s, angle_rad, speed_rad_per_s, self._factor).motion

        self._take(time_s, drive)

    def halt(self, time_s: float, acceleration_rad_per_s2: float | None = None) -> None:
        """Brake and hold."""
        with self._lock:
            self._follow(time_s)
            self._order = None
            self._pressing = False
            acceleration = min(
                acceleration_rad_per_s2 or self.settings.acceleration_rad_per_s2, _STEEPEST_RAD_PER_S2
            )
            if not self._jammed:
                self._continue(self._axis.motion.stopped(time_s, acceleration), time_s)

    def limp(self, time_s: float) -> None:
        """Let the motor go: friction brakes and holds it."""
        self.halt(time_s)

    def angle_rad(self, time_s: float) -> float:
        """Return where the motor is as its encoder has it, with the encoder's faults."""
        angle_rad = self._at(time_s).motion.at(time_s)[0]
        if fault := self._fault("wrong", time_s):
            angle_rad += fault.number("offset_rad")
        if fault := self._fault("drifting", time_s):
            angle_rad += fault.number("rate_rad_per_s") * (time_s - fault.begin_s)
        if (fault := self._fault("garbage", time_s)) and self._faults is not None:
            kind, value = self._faults.draw(fault), self._faults.draw(fault)
            angle_rad = (2 * value - 1) * (1e3 if kind < 0.5 else math.pi)
        return angle_rad

    def silent(self, time_s: float) -> bool:
        """Return whether its servo is dead."""
        return self._fault("silent", time_s) is not None

    def no_number(self, time_s: float) -> bool:
        """Return whether its angle is reported as none, where a device can report that."""
        return self._fault("not_a_number", time_s) is not None

    def velocity_rad_per_s(self, time_s: float) -> float:
        """Return how fast the motor turns."""
        return self._at(time_s).motion.at(time_s)[1]

    def mechanical_rad(self, time_s: float) -> float:
        """Return what the cameras ride on: the load behind the backlash, less the sag, ringing."""
        return self._at(time_s).mechanical_rad(time_s)

    def under_way(self, time_s: float) -> bool:
        """Return whether the motor has not come to rest where it was sent."""
        return time_s < self._at(time_s).motion.end_s

    def settles(self, time_s: float) -> bool:
        """Return whether the motor turns or did so within the settings' ``settle_s``."""
        return time_s < self._at(time_s).motion.stood_since_s + self.settings.settle_s

    def end_s(self) -> float:
        """Return when the motor comes to rest, if nothing new happens."""
        return self._axis.motion.end_s

    def rest_rad(self) -> float:
        """Return where the motor comes to rest, if nothing new happens."""
        motion = self._axis.motion
        return motion.at(motion.end_s)[0]

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
            self._follow(time_s)
            return self._order is not None and (self._jammed or self._pressing)

    def _at(self, time_s: float) -> Axis:
        """The axis as faults leave it until a moment."""
        with self._lock:
            self._follow(time_s)
            return self._axis

    def follow(self, time_s: float) -> None:
        """Let faults act until a moment; every query of the axis does so too."""
        with self._lock:
            self._follow(time_s)

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

    def _take(self, time_s: float, order: Callable[[float], Motion]) -> None:
        """Do as ordered, as far as faults allow."""
        with self._lock:
            self._follow(time_s)
            if self._jammed and not self._resumes:
                return
            self._order = order
            self._pressing = False
            if not self._jammed:
                self._continue(order(time_s), time_s)

    def _continue(self, motion: Motion, time_s: float) -> None:
        self._axis = self._axis.followed_by(motion, time_s)

    def _fault(self, word: str, time_s: float) -> Fault | None:
        """The fault of this word if it concerns this axis now."""
        fault = self._faults.find(PAN_TILT, word, time_s) if self._faults is not None else None
        if fault is None or fault.parameters.get("axis", 2.0) not in (2.0, float(self._number)):
            return None
        return fault

    def _follow(self, time_s: float) -> None:
        """Seize, free, slow down, speed up, or run against the obstacle, as the panel says."""
        if self._faults is None or time_s < self._seen_s:
            return
        self._meet_obstacle(time_s)
        jam = self._fault("off", time_s) or self._fault("stuck", time_s) or self._fault("silent", time_s)
        if (jam is not None) != self._jammed:
            self._jammed = jam is not None
            if jam is not None:
                since_s = min(time_s, max(jam.begin_s, self._axis.motion.legs[0].start_s))
                self._continue(self._axis.motion.jammed(since_s), since_s)
                self._order = self._order if self._resumes else None
            elif self._order is not None:
                self._continue(self._order(time_s), time_s)
        slow = self._fault("slow", time_s)
        factor = slow.number("factor") if slow else 1.0
        if factor != self._factor:
            self._factor = factor
            if self._order is not None and not self._jammed and time_s < self._axis.motion.end_s:
                self._continue(self._order(time_s), time_s)
        self._seen_s = time_s

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
            side = 1.0 if self._axis.motion.at(since_s)[0] >= at_rad else -1.0
            self._obstacle, self._seen_s = (fault, side), since_s
        side = self._obstacle[1]
        motion = self._axis.motion
        if side * (motion.at(time_s)[0] - at_rad) >= 0:
            return
        low_s, high_s = self._seen_s, time_s  # on this side, beyond
        for _ in range(40):
            middle_s = (low_s + high_s) / 2
            if side * (motion.at(middle_s)[0] - at_rad) >= 0:
                low_s = middle_s
            else:
                high_s = middle_s
        self._continue(motion.jammed(low_s), low_s)
        self._order = self._order if self._resumes else None
        self._pressing = True
