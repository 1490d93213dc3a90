"""Queries a unit as a whole: whether it is ready, where both axes are, how its supply is. Moves nothing.

Its protocol cannot detect a damaged digit. So a position is taken at once only where the axis is known to
rest. Otherwise the unit is queried again. A middle answer is taken if it lies between its neighbours, and
these are no further apart than the axis can go meanwhile. With one of them damaged, the answer taken still is
where the axis was during the call. A unit reports one axis at a time. Where both move they are read by turns.
Then a middle answer of pan is taken, and tilt for its moment on the straight line between the two middle
answers around it, if tilt turns evenly there.

The manuals' answer to ``O`` is ``Input 30 VDC @ 86 degF``; units with more sensors list more temperatures.
They give no bounds for all models, so the bound is by what was there at the start.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from drivers.clock import Clock
from drivers.errors import BadReply, OutOfRange, Refused, WrongDevice
from drivers.flir_ptu import protocol as queries
from drivers.flir_ptu.axis import DEVICE, Options, SeenPosition, StepAxis
from drivers.flir_ptu.conversation import Conversation

log = logging.getLogger(__name__)

MOST_QUERIES = 12  # questions for one axis; three or four do on a good line
MOST_BEND_RAD = 0.01
"""How far tilt may be from the straight line, by what its speed changes there."""

RECOMPUTE_S = 10.0  # PA and TA take seconds, the manual says

SUPPLY_EVERY_S = 5.0
"""How often a resting unit is queried."""
SUPPLY_DIP = 0.8
"""Below this part of what it was at the start a supply has fallen."""
HOTTEST_C = 60.0
"""Above this temperature of the unit, °C, there is a fault."""

_VOLTS = re.compile(r"(\d+(?:\.\d+)?) ?V")
_DEGREES_F = re.compile(r"(-?\d+(?:\.\d+)?) ?(?:deg)?F\b")


def measure(talk: Conversation, pan: StepAxis, tilt: StepAxis, clock: Clock) -> float:
    """Read both positions until they can be taken, have the axes take them, and return their moment.

    Raises BadReply if the positions contradict each other, or as `Conversation.value_of`; NoReply, Refused,
    LineLost.
    """
    seen_of: dict[StepAxis, list[SeenPosition]] = {tilt: [], pan: []}
    at_rest: dict[StepAxis, SeenPosition] = {}
    found: tuple[SeenPosition, SeenPosition] | None = None
    while found is None:
        for axis, answers in seen_of.items():
            if axis not in at_rest and found is None:
                if len(answers) == MOST_QUERIES:
                    positions = ", ".join(str(seen.position) for seen in answers)
                    raise BadReply(
                        f"gives {axis.name} positions that contradict each other: {positions}", device=DEVICE
                    )
                answers.append(_measured(talk, axis, clock))
                if axis.rests_at(answers[-1]):
                    at_rest[axis] = answers[-1]
                if len(seen_of[pan]) and len(seen_of[tilt]):
                    found = _found(pan, tilt, seen_of[pan], seen_of[tilt], at_rest)
    for axis, seen in zip((pan, tilt), found, strict=True):
        axis.take(seen)
    return found[0].time_s


def _measured(talk: Conversation, axis: StepAxis, clock: Clock) -> SeenPosition:
    """One answer, and when it was measured."""
    before_s = clock.now_s()
    number = talk.value_of(queries.POSITION[axis.name])
    # The unit looks when the question is there; its answer takes ten times as long on the wire.
    took_s = min((clock.now_s() - before_s) / 2, 4 * talk.byte_s)
    return SeenPosition(round(number), before_s + took_s)


def _found(
    pan: StepAxis,
    tilt: StepAxis,
    pans: Sequence[SeenPosition],
    tilts: Sequence[SeenPosition],
    at_rest: dict[StepAxis, SeenPosition],
) -> tuple[SeenPosition, SeenPosition] | None:
    """Pan and tilt at one moment, as far as the answers tell; None if they do not yet."""
    if pan in at_rest and tilt in at_rest:
        time_s = (at_rest[pan].time_s + at_rest[tilt].time_s) / 2
        return SeenPosition(at_rest[pan].position, time_s), SeenPosition(at_rest[tilt].position, time_s)
    if tilt in at_rest:
        seen = _middle(pan, pans)
        return None if seen is None else (seen, SeenPosition(at_rest[tilt].position, seen.time_s))
    if pan in at_rest:
        seen = _middle(tilt, tilts)
        return None if seen is None else (SeenPosition(at_rest[pan].position, seen.time_s), seen)
    if len(tilts) < 4 or len(tilts) == len(pans) or _middle(tilt, tilts[:-1]) is None:
        return None
    seen, other = _middle(pan, pans), _middle(tilt, tilts)
    if seen is None or other is None or _bend_rad(tilt, tilts[-4:]) > MOST_BEND_RAD:
        return None
    before = tilts[-3]
    part = (seen.time_s - before.time_s) / max(other.time_s - before.time_s, 1e-6)
    return seen, SeenPosition(round(before.position + part * (other.position - before.position)), seen.time_s)


def _middle(axis: StepAxis, answers: Sequence[SeenPosition]) -> SeenPosition | None:
    """The last answer but one, if those around it confirm it."""
    if len(answers) < 3 or not axis.confirms(*answers[-3:]):
        return None
    return answers[-2]


def _bend_rad(axis: StepAxis, four: Sequence[SeenPosition]) -> float:
    """How far from the straight line between the middle two of four answers the axis may have been.

    No further than these two are apart, and than its change of speed around them carries it.
    """
    speeds = [
        (then.position - now.position) / max(then.time_s - now.time_s, 1e-6) for now, then in pairwise(four)
    ]
    change = max(abs(speeds[1] - speeds[0]), abs(speeds[2] - speeds[1]))
    bend = change * (four[2].time_s - four[1].time_s) / 2
    return min(bend, abs(four[2].position - four[1].position)) * axis.position_rad


def checked_version(talk: Conversation, options: Options, known: str) -> str:
    """Return what the unit says about itself.

    Raises WrongDevice if it is another unit, or an E46 and the options do not say its resolutions; NoReply,
    BadReply, Refused, LineLost.

    ``known`` are its earlier answers; empty if it was not queried yet.
    """
    version = talk.sure_text("V")
    if known and version != known:
        message = f"another unit answers: '{version[:80]}' where '{known[:80]}' was"
        raise WrongDevice(message, device=DEVICE)
    if "E46" in version and None in (options.pan.resolution_arcsec, options.tilt.resolution_arcsec):
        raise WrongDevice(
            "is an E46, which does not know its gears before it was homed: "
            "options.pan.resolution_arcsec and options.tilt.resolution_arcsec have to say what is right",
            device=DEVICE,
        )
    return version


def ready_axes(
    talk: Conversation,
    options: Options,
    resolutions: Mapping[str, float],
    known: Mapping[str, StepAxis],
    clock: Clock,
) -> dict[str, StepAxis]:
    """Halt the unit, set its limits and speeds, and return its axes, by name, as they are seen now.

    Raises WrongDevice if it does not fit the options; NoReply, BadReply, Refused, LineLost.

    ``known`` are the axes before the unit or its line was away, whose usual speeds are kept; empty at first.
    """
    talk.request("H")
    _try(talk, "CI")  # goals are positions, not speeds
    for command in ("PO0", "TO0", "I"):  # whatever was given in slaved mode and never started is void
        talk.request(command)
    settings = {"pan": options.pan, "tilt": options.tilt}
    axes = {
        name: StepAxis(name, settings[name], talk.sure(queries.RESOLUTION[name], resolutions[name]))
        for name in settings
    }
    _try(talk, "LE")
    for axis in axes.values():
        axis.lowest, axis.highest = (int(talk.sure(q[axis.name])) for q in (queries.LOWEST, queries.HIGHEST))
        axis.check_limits()
    _limit(talk, axes)
    for name, axis in axes.items():
        axis.fastest, axis.slowest = talk.sure(queries.FASTEST[name]), talk.sure(queries.SLOWEST[name])
        if options.speed_rad_per_s is not None:
            try:
                axis.usual_speed = axis.speed_from_rad(options.speed_rad_per_s)
            except OutOfRange as error:
                raise WrongDevice(f"options.speed_rad_per_s: {error}", device=DEVICE) from None
        elif name in known:
            axis.usual_speed = known[name].usual_speed
        else:
            axis.usual_speed = int(talk.sure(queries.SPEED[name]))
        axis.acceleration = int(talk.sure(queries.ACCELERATION[name]))
        if options.acceleration_rad_per_s2 is not None:
            _accelerate(talk, axis, options.acceleration_rad_per_s2)
    measure(talk, axes["pan"], axes["tilt"], clock)
    return axes


def _limit(talk: Conversation, axes: Mapping[str, StepAxis]) -> None:
    """Put the configuration's limits into the unit, if it has user limits."""
    try:
        for name, axis in axes.items():
            for letter, end in zip("NX", axis.soft_limits(), strict=True):
                talk.request(f"{name[0].upper()}{letter}U{end}")
        talk.request("LU")
    except Refused as error:
        log.info("%s: only its factory limits hold inside the unit (%s)", DEVICE, error)
        _try(talk, "LE")


def _accelerate(talk: Conversation, axis: StepAxis, acceleration_rad_per_s2: float) -> None:
    """Set the acceleration, if the unit has another."""
    positions = max(1, round(acceleration_rad_per_s2 / axis.position_rad))
    if axis.acceleration != positions:
        talk.request(f"{axis.name[0].upper()}A{positions}", RECOMPUTE_S)
        axis.acceleration = positions


def _try(talk: Conversation, command: str) -> None:
    """Send a command that not every firmware has."""
    try:
        talk.request(command)
    except Refused as error:
        log.info("%s", error)


@dataclass(frozen=True)
class Supply:
    """Supply, volts, and the hottest temperature that the unit reports, °C."""

    volts: float
    hottest_c: float


def supply_of(text: str) -> Supply | None:
    """Return what an answer to ``O`` says; None if it says something else."""
    volts, degrees = _VOLTS.findall(text), _DEGREES_F.findall(text)
    if len(volts) != 1 or not degrees:
        return None
    return Supply(float(volts[0]), (max(float(one) for one in degrees) - 32) / 1.8)


def supply_faults(now: Supply, at_start: Supply) -> tuple[str, ...]:
    """Say what is wrong with the supply or the temperature; empty if nothing is."""
    faults = []
    low = SUPPLY_DIP * at_start.volts
    if now.volts < low:
        faults.append(f"the supply is {now.volts:.1f} V, expected {low:.1f} V or more")
    if now.hottest_c > HOTTEST_C:
        faults.append(f"the unit is at {now.hottest_c:.0f} °C, expected {HOTTEST_C:.0f} °C at most")
    return tuple(faults)


class SupplyWatch:
    """The watch over a unit's supply and temperature."""

    def __init__(self, clock: Clock) -> None:
        self.faults: tuple[str, ...] = ()
        self._clock = clock
        self._at_start: Supply | None = None  # None: this unit does not report it
        self.due_s = 0.0

    def begin(self, talk: Conversation) -> None:
        """Read what there is, unless that is known; raises as `Conversation.request`."""
        if self._at_start is not None:
            return
        first, again = _supply(talk), _supply(talk)
        if first is not None and again is not None:  # the middle, should a digit be damaged
            third = _supply(talk) or again
            self._at_start = sorted((first, again, third), key=lambda supply: supply.volts)[1]

    def check(self, talk: Conversation) -> None:
        """Read and judge now and then; a fault counts only if it is measured twice. Raises as `begin`."""
        if self._at_start is None or self._clock.now_s() < self.due_s:
            return
        faults: tuple[str, ...] = ()
        for _ in range(2):
            supply = _supply(talk)
            if supply is None:
                return  # damaged: read again by the next reading
            faults = supply_faults(supply, self._at_start)
            if not faults:
                break
        self.faults, self.due_s = faults, self._clock.now_s() + SUPPLY_EVERY_S


def _supply(talk: Conversation) -> Supply | None:
    """Supply and temperature; None where the unit does not report it, or in an unknown form."""
    try:
        return supply_of(talk.request("O"))
    except Refused as error:
        log.info("%s: it does not report its supply voltage (%s)", DEVICE, error)
        return None
