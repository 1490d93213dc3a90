"""What the driver knows about one axis: its scale and limits in positions, and where it was seen last.

A position is what the unit counts, one step of the motor. Whether a position that was read can be true, and
whether the axis has settled, is judged here and nowhere else; nothing here talks to the unit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from drivers.approach import legs_to
from drivers.errors import OutOfRange, WrongDevice
from drivers.flir_ptu.options import DEVICE, AxisOptions

ARCSEC_RAD = math.pi / 180 / 3600
SAME_RESOLUTION = 0.005
IN_POSITION = 1
"""Positions by which an encoder-corrected axis may tremble around its target."""
STALL_S = 1.0
REST_S = 0.2
"""Still at its target for so long, an axis cannot be anywhere else by the next reading."""


@dataclass(frozen=True)
class Seen:
    """A position and when it was measured, seconds."""

    position: int
    time_s: float


class StepAxis:
    """One axis.

    Parameters
    ----------
    name
        ``pan`` or ``tilt``.
    options
        Of the configuration.
    resolution_arcsec
        What the unit says one position is.

    Attributes
    ----------
    lowest, highest
        The unit's own limits, positions.
    slowest, fastest
        The unit's own bounds of speed, positions a second.
    acceleration
        Of the unit, positions a second squared.
    speed
        Set in the unit, None if unknown; ``usual_speed`` is that of moves that name none.
    target
        Where it was sent, None after a stop.
    next_target
        Where it goes from ``target``, which then is only the start of the approach.
    """

    def __init__(self, name: str, options: AxisOptions, resolution_arcsec: float) -> None:
        if not resolution_arcsec > 0:
            raise WrongDevice(
                f"says that a {name} position is {resolution_arcsec:g} seconds of arc; "
                "home it (mastctl ptu home), it does not know before",
                device=DEVICE,
            )
        told = options.resolution_arcsec
        if told is not None and abs(resolution_arcsec / told - 1) > SAME_RESOLUTION:
            raise WrongDevice(
                f"says that a {name} position is {resolution_arcsec:g} seconds of arc, "
                f"options.{name}.resolution_arcsec {told:g}; either its step mode was changed, "
                "or it is an E46 that was not homed yet (mastctl ptu home)",
                device=DEVICE,
            )
        self.name = name
        self.options = options
        self.resolution_arcsec = resolution_arcsec
        self.position_rad = resolution_arcsec * ARCSEC_RAD
        self.lowest = self.highest = 0
        self.slowest = self.fastest = 0.0
        self.acceleration = 0
        self.usual_speed = 0
        self.speed: int | None = None
        self.target: int | None = None
        self.next_target: int | None = None
        self.seen: Seen | None = None
        self._still = Seen(0, -math.inf)
        self._dwell_s = 0.0

    def rad_from_position(self, position: float) -> float:
        """Return the mast's angle of a position."""
        return self.options.sign * position * self.position_rad + self.options.zero_rad

    def position_from_rad(self, angle_rad: float) -> int:
        """Return the position nearest to an angle."""
        return round(self.options.sign * (angle_rad - self.options.zero_rad) / self.position_rad)

    def soft_limits(self) -> tuple[int, int]:
        """Return the configuration's limits as positions, the lower first."""
        ends = sorted(self.position_from_rad(end) for end in self.options.limits_rad)
        return ends[0], ends[1]

    def check_goal(self, angle_rad: float) -> None:
        """Pass an angle within the configuration's limits. Raises OutOfRange."""
        low, high = self.options.limits_rad
        if not low <= angle_rad <= high:
            raise OutOfRange(
                f"{self.name} {angle_rad:.4f} rad is outside its limits {low:.4f} to {high:.4f} rad",
                device=DEVICE,
            )

    def check_limits(self) -> None:
        """Pass limits of the configuration that the unit can reach. Raises WrongDevice."""
        low, high = self.soft_limits()
        if low < self.lowest or high > self.highest:
            wanted, own = self.options.limits_rad, sorted(
                self.rad_from_position(end) for end in (self.lowest, self.highest)
            )  # fmt: skip
            raise WrongDevice(
                f"options.{self.name}.limits_rad is {wanted[0]:.4f} to {wanted[1]:.4f} rad, "
                f"the unit itself goes from {own[0]:.4f} to {own[1]:.4f} rad",
                device=DEVICE,
            )

    def speed_from_rad(self, speed_rad_per_s: float | None) -> int:
        """Return a speed in positions a second, within what the unit does."""
        if speed_rad_per_s is None:
            return self.usual_speed
        wanted = min(speed_rad_per_s / self.position_rad, self.fastest)
        return max(math.ceil(self.slowest), 1, math.floor(wanted))

    def way_to(self, angle_rad: float) -> tuple[int, int | None]:
        """Return the first target and the one after it, so that the goal is reached from the right side."""
        goal, turn = self.position_from_rad(angle_rad), self.options.approach_sign(angle_rad)
        stretch = math.ceil(self.options.approach_rad / self.position_rad)
        here = self.target if self.rests and self.seen and self.seen.position == self.target else None
        if here == goal:
            turn = 0  # there already
        first, *then = legs_to(goal, turn, stretch, self.soft_limits(), None if here is None else [here])
        return first, then[0] if then else None

    def sent(self, target: int, time_s: float) -> None:
        """Remember a target that the unit was given."""
        self.target, self.next_target = target, None
        self._begin_again(time_s)

    def stopped(self, time_s: float) -> None:
        """Forget the target: the axis holds where it comes to rest."""
        self.target = self.next_target = None
        self._begin_again(time_s)

    def take(self, seen: Seen) -> None:
        """Remember a position that is taken for true."""
        if self.seen is None or abs(seen.position - self._still.position) > IN_POSITION:
            self._still = seen
        self.seen = seen
        self._dwell_s = seen.time_s - self._still.time_s
        if self.target is None and self._dwell_s >= REST_S:
            self.target = seen.position  # it has come to rest after a stop, and is to stay there

    def _begin_again(self, time_s: float) -> None:
        """Count the time of standing still from now."""
        self._dwell_s = 0.0
        if self.seen is not None:
            self._still = Seen(self.seen.position, time_s)

    def rests_at(self, seen: Seen) -> bool:
        """Return whether a position is the one where the axis has come to rest."""
        return self.rests and self.seen is not None and seen.position == self.seen.position

    def confirms(self, first: Seen, middle: Seen, last: Seen) -> bool:
        """Return whether the middle of three positions can be taken: see the module `position`."""
        low, high = sorted((first.position, last.position))
        furthest = self.fastest * (last.time_s - first.time_s) + 1
        return low <= middle.position <= high and high - low <= furthest

    @property
    def rests(self) -> bool:
        """Whether it was seen where it should be, and nothing was sent since."""
        return self.arrived and self._dwell_s >= REST_S

    @property
    def arrived(self) -> bool:
        """Whether it was seen at its target; without one, anywhere."""
        if self.seen is None or self.next_target is not None:
            return False
        return self.target is None or self.at_target

    @property
    def at_target(self) -> bool:
        """Whether it was seen at its present target, which may be where an approach begins."""
        if self.seen is None or self.target is None:
            return False
        return abs(self.seen.position - self.target) <= IN_POSITION

    @property
    def angle_rad(self) -> float:
        """The mast's angle where it was seen last; not-a-number before."""
        return math.nan if self.seen is None else self.rad_from_position(self.seen.position)

    def settled(self, dwell_s: float) -> bool:
        """Return whether it was at its target and still for so long when it was seen last."""
        return self.arrived and self._dwell_s >= dwell_s

    def stall_words(self) -> str:
        """Say that it stands still away from its target for longer than any start takes; else empty."""
        patience_s = max(STALL_S, 5.0 / max(self.speed or 1, 1))
        if self.seen is None or self.target is None or self.arrived or self._dwell_s <= patience_s:
            return ""
        return (
            f"{self.name} stands at {self.angle_rad:.4f} rad and does not reach its target "
            f"{self.rad_from_position(self.target):.4f} rad"
        )
