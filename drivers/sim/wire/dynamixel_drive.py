"""How the registers of a simulated servo move its axis, and what its encoder says.

Three counts are kept apart: the *raw* count is the axis angle in encoder counts from the servo's own zero;
the *position* is what the servo reports, the raw count turned round by the reverse mode, brought back to one
turn where the manual says so, and moved by the homing offset; the *trajectory* is where the profile says the
axis should be.
"""

from __future__ import annotations

import math

from drivers.sim.axis import WireAxis
from drivers.sim.motion import Motion
from drivers.sim.wire.dynamixel_models import MODES, POSITION_MODE, ControlTable, SimulatedModel

STEP_RAD_PER_S2 = 60.0
"""Acceleration where the profile has an infinite one (assumed; the manual gives none)."""

_IN_POSITION_RAD = 4 * math.tau / 4096  # the manual names no bound; this is four counts of an X
_FOLLOWING_RAD = 40 * math.tau / 4096  # as above
_ABSURD_RAD = 0.3  # more than any backlash and sag
_HOMING_LIMIT = 1024  # beyond it position control ignores the homing offset


class Drive:
    """The moving half of one servo; its raw count grows with the axis angle."""

    def __init__(
        self,
        model: SimulatedModel,
        table: ControlTable,
        axis: WireAxis,
        time_s: float,
    ) -> None:
        self.axis = axis
        self._model = model
        self._table = table
        self._shift = 0
        self._motion = Motion.at_rest(time_s, self._place_rad(time_s))
        self._profile = 0
        self.into_one_turn(time_s)

    # Counts and angles

    def _direction(self) -> int:
        return -1 if self._table["drive_mode"] & 1 else 1

    def _homing(self) -> int:
        offset = self._table["homing_offset"]
        ignored = self._table["operating_mode"] == POSITION_MODE and self._model.ram_from == 64
        return 0 if ignored and abs(offset) > _HOMING_LIMIT else offset

    def _turned(self, angle_rad: float) -> float:
        """Raw counts at an axis angle, in the servo's direction."""
        raw = self._model.zero_counts + angle_rad / self._model.count_rad
        return self._direction() * raw

    def _counts(self, angle_rad: float) -> int:
        return round(self._turned(angle_rad)) - self._shift + self._homing()

    def _angle_rad(self, counts: int) -> float:
        raw = self._direction() * (counts - self._homing() + self._shift)
        return (raw - self._model.zero_counts) * self._model.count_rad

    def _place_rad(self, time_s: float) -> float:
        """The encoder's angle; where a fault makes it absurd, the load's, so that no turn is lost."""
        angle, load = self.axis.angle_rad(time_s), self.axis.mechanical_rad(time_s)
        return angle if abs(angle - load) < _ABSURD_RAD else load

    def into_one_turn(self, time_s: float) -> None:
        """Bring the position back to one turn: 0 to a turn, or half a turn either way on a P."""
        turn, raw = self._model.counts_per_turn, round(self._turned(self._place_rad(time_s)))
        low = 0 if self._model.zero_counts else -turn // 2
        self._shift = (raw - low) // turn * turn

    def position(self, time_s: float) -> int:
        """Return Present Position."""
        return self._counts(self.axis.angle_rad(time_s))

    def velocity(self, time_s: float) -> int:
        """Return Present Velocity."""
        speed = self._direction() * self.axis.velocity_rad_per_s(time_s)
        return round(speed / self._model.velocity_unit_rad_per_s)

    # Orders

    def rest(self, time_s: float) -> None:
        """Take the place where the axis is as the end of the trajectory."""
        self._motion = Motion.at_rest(time_s, self._place_rad(time_s))
        self._profile = 0

    def torque_on(self, time_s: float) -> None:
        """Hold where it is; goals are where it is and no velocity."""
        self.axis.halt(time_s)
        if self._table["operating_mode"] == POSITION_MODE:
            self.into_one_turn(time_s)
        self.rest(time_s)
        self._table["goal_position"] = self.position(time_s)
        self._table["goal_velocity"] = 0

    def stop(self, time_s: float) -> None:
        """Stop at once, as though both profile registers were 0; so do the bus watchdog and torque off."""
        self.axis.halt(time_s)
        self.rest(time_s)

    def _top_rad_per_s(self) -> float:
        return max(1, self._table["velocity_limit"]) * self._model.velocity_unit_rad_per_s

    def go(self, time_s: float) -> None:
        """Start the profile to Goal Position, if it is the operating mode's."""
        if self._table["operating_mode"] not in MODES:
            return
        angle = self._angle_rad(self._table["goal_position"])
        distance = abs(angle - self._motion.at(time_s)[0])
        velocity, units = self._table["profile_velocity"], self._table["profile_acceleration"]
        speed = min(velocity * self._model.velocity_unit_rad_per_s or math.inf, self._top_rad_per_s())
        acceleration = units * self._model.acceleration_unit_rad_per_s2 or STEP_RAD_PER_S2
        if velocity == 0:
            self._profile = 0
        elif units == 0:
            self._profile = 1
        else:
            self._profile = 3 if distance >= speed * speed / acceleration * (1 - 1e-9) else 2
        self._motion = self._motion.moved(time_s, [angle], speed, acceleration)
        self.axis.goal(time_s, angle, speed, acceleration)

    # What the servo says about its motion

    def _on(self) -> bool:
        return self._table["torque_enable"] == 1

    def _positioning(self) -> bool:
        return self._on() and self._table["operating_mode"] in MODES

    def _trajectory(self, time_s: float) -> tuple[float, float]:
        """Where the profile is and how fast; the axis itself where there is none."""
        if self._positioning():
            return self._motion.at(time_s)
        return self.axis.angle_rad(time_s), self.axis.velocity_rad_per_s(time_s)

    def error_rad(self, time_s: float) -> float:
        """Return by how much the axis is behind the trajectory, radians of the axis."""
        return self._trajectory(time_s)[0] - self.axis.angle_rad(time_s)

    def ongoing(self, time_s: float) -> bool:
        """Return whether a profile is under way."""
        return self._positioning() and time_s < self._motion.end_s

    def moving(self, time_s: float) -> int:
        """Return Moving."""
        fast = abs(self.velocity(time_s)) > self._table["moving_threshold"]
        return int(fast or self.ongoing(time_s))

    def moving_status(self, time_s: float) -> int:
        """Return Moving Status: in position, profile ongoing, following error, type of profile."""
        if not self._positioning():
            return 0
        off = abs(self._table["goal_position"] - self.position(time_s)) * self._model.count_rad
        status = self._profile << 4 if self.ongoing(time_s) else 0
        status |= 1 if off <= _IN_POSITION_RAD else 0
        status |= 2 if self.ongoing(time_s) else 0
        return status | (8 if abs(self.error_rad(time_s)) > _FOLLOWING_RAD else 0)

    def trajectory_position(self, time_s: float) -> int:
        """Return Position Trajectory."""
        return self._counts(self._trajectory(time_s)[0])

    def trajectory_velocity(self, time_s: float) -> int:
        """Return Velocity Trajectory."""
        speed = self._direction() * self._trajectory(time_s)[1]
        return round(speed / self._model.velocity_unit_rad_per_s)

    def pushes(self, time_s: float) -> bool:
        """Return whether the motor pushes in vain: something is in the way of where it shall go."""
        if not self._on() or not self.axis.blocked(time_s):
            return False
        return not self._positioning() or abs(self.error_rad(time_s)) > _IN_POSITION_RAD

    def effort(self, time_s: float) -> float:
        """Return the share of its strength that the motor uses, -1 to 1, in the servo's direction.

        A plain picture, not a motor model: friction while it turns, a stiff spring towards the trajectory,
        so that a seized axis draws full current.
        """
        if not self._on():
            return 0.0
        friction = math.tanh(self.axis.velocity_rad_per_s(time_s) / 0.05) * 0.08
        push = self._direction() * (friction + 12.0 * self.error_rad(time_s))
        return max(-1.0, min(1.0, push))
