"""Driver ``flir_ptu``: Directed Perception / FLIR D46, D47, D48E and E46 as a `drivers.interfaces.PanTilt`.

It has no thread. Whoever calls waits for the unit, never longer than a few reply times. It is not responsible
for the service's soft limits and not for the decision what to do about a fault: it reports.

- Both axes start together: the goals are sent in slaved mode (``S``) and begin with ``I``. Each step is
  confirmed by the unit's echo, so a goal that was garbled on the way never starts. ``A`` is not used, since
  it holds back every answer until the motion is over.
- The protocol cannot detect a damaged digit. So a position is taken at once only where the axis rests by
  all that is known. Otherwise the unit is asked three times, and the middle answer is taken if it lies
  between the other two, and these no further apart than the axis can go meanwhile: with one of them damaged,
  what is taken still is where the axis was during the call.
- A limit hit (``!P``, ``!T``) of an axis that stands still is damaged bytes or a restart: all of the unit is
  checked again, its positions too.
- After a limit hit of a moving axis, or when a position has changed while the line was down, the unit has
  lost count. Then it is read but not moved until it was homed (``mastctl ptu home``), which sweeps the full
  range and which this driver never does, and opened anew.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any

from drivers.clock import Clock, SystemClock
from drivers.errors import (
    BadReply,
    DriverError,
    HardwareFault,
    LineLost,
    NoReply,
    OutOfRange,
    Refused,
    WrongDevice,
)
from drivers.flir_ptu import conversation as ask
from drivers.flir_ptu.axis import Axis, Seen
from drivers.flir_ptu.conversation import Conversation
from drivers.flir_ptu.line import Line
from drivers.flir_ptu.options import DEVICE, Options, options_from
from drivers.flir_ptu.supply import EVERY_S, Supply, supply_of, supply_words
from drivers.interfaces import Reading

log = logging.getLogger(__name__)

ASKED_AT_MOST = 7  # questions for one position
SILENT_CALLS = 5  # calls without an answer, after which the line is opened anew
FIRST_BACK_OFF_S, LONGEST_BACK_OFF_S = 0.1, 2.0
STOP_PATIENCE_S = 0.02  # how long a stop waits for a call that is under way before it goes out beside it
RECOMPUTE_S = 10.0  # PA and TA take seconds, the manual says
BRAKING_S = 0.5  # an axis that was under way when it was seen last may have gone on for so long
HIT = (
    "the {axis} axis ran into its limit switch, so the unit has lost count of its position; "
    "home it (mastctl ptu home)"
)
JUMPED = (
    "{axis} was at {before:.4f} rad before the unit or its line was away and is at {after:.4f} rad now, "
    "so the unit may have lost count; home it (mastctl ptu home)"
)


def open_head(options: Mapping[str, Any], clock: Clock | None = None) -> FlirPtu:
    """Return the open head that the options name.

    Parameters
    ----------
    options
        See `drivers.flir_ptu.options`.
    clock
        Stamps the readings; the machine's monotonic clock when left out.

    Raises
    ------
    BadOptions
        For options that cannot be used.
    WrongDevice
        If what answers does not fit them.
    LineLost, NoReply, BadReply, Refused
        If the unit cannot be reached.
    """
    return FlirPtu(options_from(options), clock or SystemClock())


class FlirPtu:
    """An open unit; safe to use from any thread. Opening stops it and moves nothing.

    Attributes
    ----------
    version
        What the unit says about itself.
    """

    def __init__(self, options: Options, clock: Clock) -> None:
        self._options = options
        self._clock = clock
        self._lock = threading.RLock()
        self._stop_asked = threading.Event()
        self._lost_count: dict[str, str] = {}
        self._halt_owed = False
        self._doubted: dict[str, float] = {}  # where the axes stood when a limit hit was told of one, rad
        self._deaf = False  # to limit hits
        self._closed = False
        self._silent = 0  # calls in a row without an answer
        self._lost: DriverError | None = None
        self._back_off_s, self._retry_s = FIRST_BACK_OFF_S, 0.0
        self._byte_s = 0.0
        self._talk: Conversation | None = None
        self._axes: dict[str, Axis] = {}
        self._first_supply: Supply | None = None  # None: this unit does not tell
        self._supply_words: tuple[str, ...] = ()
        self._supply_due_s = 0.0
        self.version = ""
        self._connect()

    def read(self) -> Reading:
        """Return where the axes are.

        Raises
        ------
        NoReply, BadReply
            If the unit is silent, or says what cannot be true.
        LineLost
            If the line is gone; a later call opens it anew.
        WrongDevice
            If what answers after that does not fit the options any more.
        """
        with self._talking() as talk:
            pan, tilt = self._axes["pan"], self._axes["tilt"]
            times_s = [self._measure(talk, axis).time_s for axis in (pan, tilt)]
            if self._halt_owed:
                self._halt(talk)
            for axis in (pan, tilt):
                self._go_on(talk, axis)
            settled = all(axis.settled(self._options.settle_s) for axis in (pan, tilt))
            if settled:  # a moving head is asked for nothing but its place
                self._watch_supply(talk)
            return Reading(pan.angle_rad, tilt.angle_rad, not settled, sum(times_s) / 2, self._faults())

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        """Start both axes together towards the nearest positions; readings carry an approach on.

        Raises
        ------
        OutOfRange
            For an angle outside the limits or a speed that is no positive number; nothing was sent.
        HardwareFault
            If the unit has lost count of its position.
        Refused
            If the unit will not, in its own words.
        NoReply, BadReply, LineLost
            If it did not confirm; unless only the last step is unconfirmed, nothing moves.
        """
        goals = {"pan": pan_rad, "tilt": tilt_rad}
        for name, angle in goals.items():
            self._axes[name].check_goal(angle)
        if speed_rad_per_s is not None and not speed_rad_per_s > 0:
            raise OutOfRange(f"speed {speed_rad_per_s} rad/s is not a positive number", device=DEVICE)
        with self._talking() as talk:
            if self._lost_count:
                raise HardwareFault("; ".join(self._lost_count.values()), device=DEVICE)
            ways = {name: axis.way_to(goals[name]) for name, axis in self._axes.items()}
            for axis in self._axes.values():
                axis.next_target = None
                self._set_speed(talk, axis, axis.speed_from_rad(speed_rad_per_s))
            talk.tell("S")
            for name, (target, _) in ways.items():
                talk.tell(f"{name[0].upper()}P{target}")
            if self._doubted:
                words = "told of a limit hit while it stood still; it is checked before it moves"
                raise BadReply(words, device=DEVICE)
            if self._stop_asked.is_set():
                raise DriverError("a stop came before the move was started", device=DEVICE)
            for name, axis in self._axes.items():
                axis.sent(ways[name][0], self._clock.now_s())
            talk.tell("I")
            for name, axis in self._axes.items():
                axis.next_target = ways[name][1]

    def stop(self) -> None:
        """Halt both axes; they hold where they come to rest.

        If another call is under way the halt goes out beside it at once, and again in order.

        Raises
        ------
        NoReply, BadReply, LineLost
            If the unit did not confirm.
        """
        self._stop_asked.set()
        free = self._lock.acquire(timeout=STOP_PATIENCE_S)
        try:
            talk = self._talk
            if talk is not None and not (free and talk.is_in_step):
                with suppress(LineLost):  # told below
                    talk.shout("H")
            with self._talking() as talk:
                self._halt(talk)
        finally:
            self._stop_asked.clear()
            if free:
                self._lock.release()

    def close(self) -> None:
        """Halt and let go of the line."""
        with self._lock:
            if self._closed:
                return
            try:
                if self._talk is not None:
                    self.stop()
            except DriverError as error:
                log.warning("the last stop was not confirmed: %s", error)
            self._closed = True
            self._drop()

    # The line

    @contextmanager
    def _talking(self) -> Iterator[Conversation]:
        """The conversation in step, for one caller at a time; a line that turns out dead is closed."""
        with self._lock:
            if self._closed:
                raise NoReply("it is closed", device=DEVICE)
            talk = self._talk or self._connect()
            try:
                if self._doubted:
                    self._look_again(talk)
                elif not talk.is_in_step:
                    self._come_into_step(talk)
                yield talk
            except (LineLost, NoReply) as error:
                self._silent += 1
                if isinstance(error, LineLost) or self._silent >= SILENT_CALLS:
                    self._give_up(error)
                raise
            self._silent = 0

    def _connect(self) -> Conversation:
        """Open the line, check the unit, and leave it standing still; not too often."""
        if self._lost is not None and time.monotonic() < self._retry_s:
            raise self._lost.with_traceback(None)
        self._deaf = True  # a unit that homes itself at power-up reports its limit switches
        try:
            line = Line(self._options.port, self._options.baud, DEVICE)
            self._byte_s = line.byte_s
            talk = self._talk = Conversation(line, DEVICE, self._hit)
            resolutions = talk.in_step()
            self._deaf = False
            with talk.patient():
                self._check(talk, resolutions)
        except DriverError as error:
            self._give_up(error)
            raise
        finally:
            self._deaf = False
        if self._lost is not None:
            log.info("%s: the line is back", DEVICE)
        self._lost, self._back_off_s, self._silent = None, FIRST_BACK_OFF_S, 0
        return talk

    def _give_up(self, error: DriverError) -> None:
        """Close the line, and remember why and until when."""
        self._lost = error
        self._retry_s = time.monotonic() + self._back_off_s
        self._back_off_s = min(2 * self._back_off_s, LONGEST_BACK_OFF_S)
        self._drop()

    def _drop(self) -> None:
        """Close the line."""
        talk, self._talk = self._talk, None
        if talk is not None:
            talk.close()

    def _come_into_step(self, talk: Conversation) -> None:
        """Go on after an error; a unit that was reset or restarted meanwhile is checked anew."""
        resolutions = talk.in_step()
        pan = self._axes["pan"]
        changed = any(axis.resolution_arcsec != resolutions[name] for name, axis in self._axes.items())
        if changed or (pan.speed is not None and round(talk.ask(ask.SPEED["pan"])) != pan.speed):
            log.warning("%s: resolution or speed are not as they were; it was reset or restarted", DEVICE)
            with talk.patient():
                self._check(talk, resolutions)

    def _look_again(self, talk: Conversation) -> None:
        """Check the unit anew, its positions too: it may have restarted, or only some bytes were damaged."""
        resolutions = talk.in_step()
        with talk.patient():
            self._check(talk, resolutions)
        stood, self._doubted = self._doubted, {}
        for name, before_rad in stood.items():
            axis = self._axes[name]
            if abs(axis.angle_rad - before_rad) > 1.5 * axis.position_rad:
                self._note_jump(name, before_rad, axis.angle_rad)

    # The unit

    def _check(self, talk: Conversation, resolutions: Mapping[str, float]) -> None:
        """Halt the unit, compare it with the options, and set limits and speeds. Moves nothing."""
        options = {"pan": self._options.pan, "tilt": self._options.tilt}
        version = talk.tell("V")
        if self.version and version != self.version:
            words = f"another unit answers: '{version[:80]}' where '{self.version[:80]}' was"
            raise WrongDevice(words, device=DEVICE)
        if "E46" in version and None in (options["pan"].resolution_arcsec, options["tilt"].resolution_arcsec):
            raise WrongDevice(
                "is an E46, which does not know its gears before it was homed: "
                "options.pan.resolution_arcsec and options.tilt.resolution_arcsec have to say what is right",
                device=DEVICE,
            )
        talk.tell("H")
        self._try(talk, "CI")  # goals are positions, not speeds
        for command in ("PO0", "TO0", "I"):  # whatever was given in slaved mode and never started is void
            talk.tell(command)
        axes = {name: Axis(name, options[name], resolutions[name]) for name in options}
        self._try(talk, "LE")
        for axis in axes.values():
            axis.lowest, axis.highest = (int(talk.ask(q[axis.name])) for q in (ask.LOWEST, ask.HIGHEST))
            axis.check_limits()
        self._limit(talk, axes)
        for name, axis in axes.items():
            axis.fastest, axis.slowest = talk.ask(ask.FASTEST[name]), talk.ask(ask.SLOWEST[name])
            known = self._axes.get(name)
            if self._options.speed_rad_per_s is not None:
                axis.usual_speed = axis.speed_from_rad(self._options.speed_rad_per_s)
            elif known is not None:
                axis.usual_speed = known.usual_speed
            else:
                axis.usual_speed = int(talk.ask(ask.SPEED[name]))
            self._accelerate(talk, axis)
            self._measure(talk, axis)
            if known is not None:
                self._compare(known, axis)
        self.version, self._axes = version, axes
        if self._first_supply is None:
            first, again = self._ask_supply(talk), self._ask_supply(talk)
            if first is not None and again is not None:  # the middle, should a digit be damaged
                third = self._ask_supply(talk) or again
                self._first_supply = sorted((first, again, third), key=lambda supply: supply.volts)[1]

    def _limit(self, talk: Conversation, axes: Mapping[str, Axis]) -> None:
        """Put the configuration's limits into the unit, if it has user limits."""
        try:
            for name, axis in axes.items():
                for letter, end in zip("NX", axis.soft_limits(), strict=True):
                    talk.tell(f"{name[0].upper()}{letter}U{end}")
            talk.tell("LU")
        except Refused as error:
            log.info("%s: only its factory limits hold inside the unit (%s)", DEVICE, error)
            self._try(talk, "LE")

    def _accelerate(self, talk: Conversation, axis: Axis) -> None:
        """Set the acceleration, if one is configured and the unit has another."""
        wanted = self._options.acceleration_rad_per_s2
        if wanted is None:
            return
        positions = max(1, round(wanted / axis.position_rad))
        if int(talk.ask(ask.ACCELERATION[axis.name])) != positions:
            talk.tell(f"{axis.name[0].upper()}A{positions}", RECOMPUTE_S)

    def _set_speed(self, talk: Conversation, axis: Axis, speed: int) -> None:
        """Set an axis's speed unless it is set already."""
        if axis.speed != speed:
            axis.speed = None
            talk.tell(f"{axis.name[0].upper()}S{speed}")
            axis.speed = speed

    def _measure(self, talk: Conversation, axis: Axis) -> Seen:
        """Ask for a position until it can be taken: the one where the axis rests, or the middle of three."""
        asked: list[Seen] = []
        while len(asked) < ASKED_AT_MOST:
            before_s = self._clock.now_s()
            number = talk.ask(ask.POSITION[axis.name])
            # The unit looks when the question is there; its answer takes ten times as long on the wire.
            took_s = min((self._clock.now_s() - before_s) / 2, 4 * self._byte_s)
            asked.append(Seen(round(number), before_s + took_s))
            if axis.rests_at(asked[-1]) or (len(asked) >= 3 and axis.confirms(*asked[-3:])):
                seen = asked[-1] if axis.rests_at(asked[-1]) else asked[-2]
                axis.take(seen)
                return seen
        words = ", ".join(str(seen.position) for seen in asked)
        raise BadReply(f"gives {axis.name} positions that contradict each other: {words}", device=DEVICE)

    def _halt(self, talk: Conversation) -> None:
        """Halt both axes."""
        talk.tell("H")
        self._halt_owed = False
        for axis in self._axes.values():
            axis.stopped(self._clock.now_s())

    def _go_on(self, talk: Conversation, axis: Axis) -> None:
        """Send an axis that is where its approach begins to its goal."""
        if axis.next_target is not None and axis.at_target and not self._stop_asked.is_set():
            talk.tell(f"{axis.name[0].upper()}P{axis.next_target}")
            axis.sent(axis.next_target, self._clock.now_s())

    def _watch_supply(self, talk: Conversation) -> None:
        """Judge supply and temperature now and then; a fault is told only if it is measured twice."""
        if self._first_supply is None or time.monotonic() < self._supply_due_s:
            return
        words: tuple[str, ...] = ()
        for _ in range(2):
            supply = self._ask_supply(talk)
            if supply is None:
                return  # damaged: asked again by the next reading
            words = supply_words(supply, self._first_supply, self._options)
            if not words:
                break
        self._supply_words, self._supply_due_s = words, time.monotonic() + EVERY_S

    def _ask_supply(self, talk: Conversation) -> Supply | None:
        """Supply and temperature; None where the unit does not tell, or in words nobody knows."""
        try:
            return supply_of(talk.tell("O"))
        except Refused as error:
            log.info("%s: it does not tell its supply (%s)", DEVICE, error)
            return None

    def _try(self, talk: Conversation, command: str) -> None:
        """Send a command that not every firmware has."""
        try:
            talk.tell(command)
        except Refused as error:
            log.info("%s", error)

    # What is wrong

    def _hit(self, axis: str) -> None:
        """An axis ran into its limit switch; inside its limits that happens only when it has lost count.

        A head that stood still cannot have: that is a restart, or noise, and is looked into.
        """
        if self._deaf:
            return
        if self._doubted:
            return
        if self._axes and all(one.rests for one in self._axes.values()):
            log.warning("%s: a limit hit is told of the %s axis, which stands still", DEVICE, axis)
            self._doubted = {name: one.angle_rad for name, one in self._axes.items()}
            return
        self._halt_owed = True
        if axis not in self._lost_count:
            self._lost_count[axis] = HIT.format(axis=axis)
            log.warning("%s: %s", DEVICE, self._lost_count[axis])

    def _compare(self, before: Axis, after: Axis) -> None:
        """Note a position that the axis cannot have reached since it was seen last."""
        if before.seen is None or after.seen is None or after.name in self._lost_count:
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
        words = JUMPED.format(axis=axis, before=before_rad, after=after_rad)
        self._lost_count[axis] = words
        log.warning("%s: %s", DEVICE, words)

    def _faults(self) -> tuple[str, ...]:
        """What is wrong, in plain words."""
        return (
            *self._lost_count.values(),
            *self._supply_words,
            *(
                f"{axis.name} stands at {axis.angle_rad:.4f} rad and does not reach its target "
                f"{axis.rad_from_position(axis.target):.4f} rad"
                for axis in self._axes.values()
                if axis.stalled() and axis.target is not None
            ),
        )
