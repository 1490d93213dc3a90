"""The driver's knowledge of the axes: scale, limits, where each was seen last, whether its count holds.

A position is what the unit counts, one step of the motor. Whether a position that was read can be true, and
whether the axis has settled, is judged here and nowhere else; nothing here talks to the unit.

A unit counts steps and has no encoder. Inside its limits an axis runs into a limit switch (``!P``, ``!T``)
only when it has lost count. For an axis that stands still the message is damaged bytes or a restart, so all
of the unit is checked again, its positions too. An axis that is somewhere else after the line was down has
lost count as well.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Annotated

from pydantic import AfterValidator, Field, WithJsonSchema

from calib.files.records import Text, problem
from drivers.approach import ApproachedAxis, legs_to
from drivers.errors import OutOfRange, WrongDevice
from drivers.options import Ascending, DriverOptions, one_of, read_options

DEVICE = "flir_ptu"
# The manuals name 9600 (default) and 38,400 (4.7.1); that a unit takes the others was seen in no source.
BAUDS = (600, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200)


def _port(port: str) -> str:
    if "://" in port and not port.startswith("socket://"):
        ports = "a serial device such as /dev/ttyUSB0, or socket://HOST:4000"
        raise problem("", f"{port!r} where {ports} is expected")
    return port


class AxisOptions(ApproachedAxis):
    """One axis; its limits are also the unit's user limits, if it has any."""

    limits_rad: Annotated[tuple[float, float], Ascending(-math.tau, math.tau)]
    """What may be commanded; set in the unit too, if it can be."""
    zero_rad: Annotated[float, Field(ge=-math.tau, le=math.tau)] = 0.0
    """The axis's angle where the unit is at position 0."""
    resolution_arcsec: Annotated[float, Field(ge=0.1, le=3600.0)] | None = None
    """The size of a position, seconds of arc; left out: the unit's own. An E46 needs it, since it reports a
    wrong one before its first reset."""


class Options(DriverOptions):
    """A unit."""

    port: Annotated[Text, AfterValidator(_port)]
    """The line: a serial device, or socket://HOST:4000."""
    pan: AxisOptions
    """The pan axis."""
    tilt: AxisOptions
    """The tilt axis."""
    baud: Annotated[int, one_of(BAUDS), WithJsonSchema({"enum": [*BAUDS]})] = 9600
    """The line's bits per second; ``socket://`` has none."""
    speed_rad_per_s: Annotated[float, Field(ge=1e-4, le=20.0)] | None = None
    """Of moves that name no speed; left out: as the unit has it."""
    acceleration_rad_per_s2: Annotated[float, Field(ge=1e-4, le=100.0)] | None = None
    """Of all moves; left out: as the unit has it."""
    settle_s: Annotated[float, Field(ge=0.0, le=10.0)] = 0.1
    """How long both axes must be at rest at their targets to count as settled."""


options_from = partial(read_options, Options)
"""Return the options that a configuration holds. Raises BadOptions."""


log = logging.getLogger(__name__)

ARCSEC_RAD = math.pi / 180 / 3600
SAME_RESOLUTION = 0.005
SAME_SPEED = 1e-6
"""Positions a second that rounding may take from a speed which was given in radians."""
IN_POSITION = 1
"""Positions by which an encoder-corrected axis may tremble around its target."""
STALL_S = 1.0
REST_S = 0.2
"""Still at its target for so long, an axis cannot be anywhere else by the next reading."""

BRAKING_S = 0.5  # an axis that was under way when it was seen last may have gone on for so long
HIT = (
    "the {axis} axis ran into its limit switch, so the unit has lost count of its position; "
    "home it (mastctl rig ptu home)"
)
JUMPED = (
    "{axis} was at {before:.4f} rad before the connection was lost and is at {after:.4f} rad now, "
    "so the unit may have lost count; home it (mastctl rig ptu home)"
)


@dataclass(frozen=True)
class SeenPosition:
    """A position and when it was measured, seconds."""

    position: int
    time_s: float


class StepAxis:
    """One axis, in positions, positions a second, and positions a second squared.

    Attributes
    ----------
    slowest, fastest
        The unit's own bounds of speed, positions a second.
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
                "home it (mastctl rig ptu home), it does not know before",
                device=DEVICE,
            )
        configured = options.resolution_arcsec
        if configured is not None and abs(resolution_arcsec / configured - 1) > SAME_RESOLUTION:
            raise WrongDevice(
                f"says that a {name} position is {resolution_arcsec:g} seconds of arc, "
                f"options.{name}.resolution_arcsec {configured:g}. Either its step mode was changed, "
                "or it is an E46 that was not homed yet (mastctl rig ptu home)",
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
        self.seen: SeenPosition | None = None
        self._still = SeenPosition(0, -math.inf)
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
        """Return a speed in positions a second, rounded down, and at most the unit's fastest.

        Raises OutOfRange for a speed below the unit's slowest.
        """
        if speed_rad_per_s is None:
            return self.usual_speed
        slowest = max(math.ceil(self.slowest), 1)
        wanted = math.floor(min(speed_rad_per_s / self.position_rad + SAME_SPEED, self.fastest))
        if wanted < slowest:
            least = math.ceil(1e5 * slowest * self.position_rad) / 1e5
            raise OutOfRange(
                f"speed {speed_rad_per_s:g} rad/s is below the {least:g} rad/s at which the unit's "
                f"{self.name} axis turns slowest; request a higher speed"
            )
        return wanted

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

    def take(self, seen: SeenPosition) -> None:
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
            self._still = SeenPosition(self.seen.position, time_s)

    def rests_at(self, seen: SeenPosition) -> bool:
        """Return whether a position is the one where the axis has come to rest."""
        return self.rests and self.seen is not None and seen.position == self.seen.position

    def confirms(self, first: SeenPosition, middle: SeenPosition, last: SeenPosition) -> bool:
        """Return whether the middle of three positions can be taken: see `drivers.flir_ptu.unit`."""
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

    def stall_fault(self) -> str:
        """Say that it stands still away from its target for longer than any start takes; else empty."""
        patience_s = max(STALL_S, 5.0 / max(self.speed or 1, 1))
        if self.seen is None or self.target is None or self.arrived or self._dwell_s <= patience_s:
            return ""
        return (
            f"{self.name} stands at {self.angle_rad:.4f} rad and does not reach its target "
            f"{self.rad_from_position(self.target):.4f} rad"
        )


class StepCount:
    """The evidence against the positions that a unit reports.

    ``lost`` says by axis why its count is lost; it stays lost. ``suspected`` is where the axes stood, rad,
    when a limit hit was reported of one that stood still: to be checked, and then compared by
    `compare_places`. ``halt_owed``: whether a moving axis has hit its limit since the unit was halted last.
    """

    def __init__(self) -> None:
        self.lost: dict[str, str] = {}
        self.suspected: dict[str, float] = {}
        self.halt_owed = False

    def hit(self, axis: str, axes: Mapping[str, StepAxis]) -> None:
        """Note a limit hit of an axis; ``axes`` as they are known, empty before the unit is checked."""
        if self.suspected:
            return
        if axes and all(one.rests for one in axes.values()):
            log.warning("%s: the unit reports a limit hit of the %s axis, which stands still", DEVICE, axis)
            self.suspected = {name: one.angle_rad for name, one in axes.items()}
            return
        self.halt_owed = True
        if axis not in self.lost:
            self.lost[axis] = HIT.format(axis=axis)
            log.warning("%s: %s", DEVICE, self.lost[axis])

    def compare_places(self, axes: Mapping[str, StepAxis]) -> None:
        """Compare the axes, checked anew, with their places when a limit hit was reported; that is over."""
        stood, self.suspected = self.suspected, {}
        for name, before_rad in stood.items():
            if abs(axes[name].angle_rad - before_rad) > 1.5 * axes[name].position_rad:
                self._note_jump(name, before_rad, axes[name].angle_rad)

    def compare(self, before: StepAxis, after: StepAxis) -> None:
        """Note a position, ``after``, that the axis cannot have reached since it was seen ``before``."""
        if before.seen is None or after.seen is None or after.name in self.lost:
            return
        ways = [before.angle_rad]
        slack_rad = 1.5 * max(before.position_rad, after.position_rad)
        if before.next_target is not None or not before.at_target:  # it may have gone on, and braked
            ends = (before.target, before.next_target)
            ways += [before.rad_from_position(end) for end in ends if end is not None]
            slack_rad += BRAKING_S * (before.speed or before.fastest) * before.position_rad
        if not min(ways) - slack_rad <= after.angle_rad <= max(ways) + slack_rad:
            self._note_jump(after.name, before.angle_rad, after.angle_rad)

    def _note_jump(self, axis: str, before_rad: float, after_rad: float) -> None:
        """An axis is where it cannot be by itself."""
        message = JUMPED.format(axis=axis, before=before_rad, after=after_rad)
        self.lost[axis] = message
        log.warning("%s: %s", DEVICE, message)
