"""Driver ``flir_ptu``: Directed Perception / FLIR D46, D47, D48E and E46 as a `drivers.interfaces.PanTilt`.

The caller waits for the unit, never longer than a few reply times. A thread runs only while an axis is on its
way to where an approach begins, and sends it on from there; reading moves nothing. The driver is not
responsible for the service's soft limits and not for the decision what to do about a fault: it reports.

- Both axes start together: the goals are sent in slaved mode (``S``) and begin with ``I``. Each step is
  confirmed by the unit's echo, so a goal that was garbled on the way never starts. ``A`` is not used, since
  it holds back every answer until the motion is over.
- Once a limit hit or a changed position has shown that the unit has lost count (`drivers.flir_ptu.axis`),
  it is read but not moved until it was homed (``mastctl rig ptu home``), which sweeps the full range and
  which this driver never does, and opened anew.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any

from drivers.absent import Absence, stop_at_last
from drivers.approach import check_goal
from drivers.clock import Clock, ClockLock, SystemClock, deadlines_on
from drivers.errors import BadReply, DriverError, HardwareFault, LineLost, NoReply
from drivers.flir_ptu import protocol as queries
from drivers.flir_ptu.axis import DEVICE, Options, StepAxis, StepCount, options_from
from drivers.flir_ptu.conversation import Conversation, StopCameFirst
from drivers.flir_ptu.unit import SupplyWatch, checked_version, measure, ready_axes
from drivers.flir_ptu.workshop import BENCH, probe, talking
from drivers.interfaces import AxisMotion, HeadInfo, PanTilt, Reading
from drivers.registry import Driver
from drivers.serial_line import OpenLine, SerialLine

log = logging.getLogger(__name__)

SILENT_CALLS = 5  # calls without an answer, after which the line is opened anew
STOP_OVER_S = 1.0  # how long a reading waits for the stop that it gave way to
LEG_POLL_S = 0.05  # how often an axis that is to go on from where its approach begins is looked at
GIVING_WAY_S = 2.0  # how long a reading begins anew where one stop comes after another


def open_head(
    options: Mapping[str, Any], clock: Clock | None = None, open_line: OpenLine = SerialLine
) -> FlirPtu:
    """Return the open head that the options name; its readings are stamped by ``clock``.

    Raises BadOptions for options that cannot be used; WrongDevice if what answers does not fit them;
    LineLost, NoReply, BadReply, Refused.
    """
    return FlirPtu(options_from(options), clock or SystemClock(), open_line)


class FlirPtu(PanTilt):
    """An open unit; safe to use from any thread. Opening stops it and moves nothing."""

    def __init__(self, options: Options, clock: Clock, open_line: OpenLine) -> None:
        self._options = options
        self._clock = clock
        self._time = deadlines_on(clock)
        self._open_line = open_line
        self._turn = ClockLock(self._time)
        self._stop_over = self._time.signal()
        self._stop_requested = False
        self._finishing = False  # whether a thread sends last stretches
        self._leg_due = False  # whether it waits for its turn: readings one after another leave it none
        self._count = StepCount()
        self._supply = SupplyWatch(self._time)
        self._absence = Absence()
        self._deaf = False  # to limit hits
        self._closed = False
        self._silent = 0  # calls in a row without an answer
        self._talk: Conversation | None = None
        self._axes: dict[str, StepAxis] = {}
        self.version = ""
        self._connect()

    def read(self) -> Reading:
        """Return where the axes are. A stop that comes meanwhile goes first.

        Raises NoReply, BadReply if the unit is silent, or says what cannot be true; LineLost if the line is
        gone; a later call opens it anew; WrongDevice if what answers after that does not fit the options any
        more.
        """
        until_s = self._time.now_s() + GIVING_WAY_S
        while True:
            with self._stop_over:
                if self._leg_due:
                    self._stop_over.wait(STOP_OVER_S)
            try:
                return self._read()
            except StopCameFirst:  # several stops may come into one reading
                if self._time.now_s() > until_s:
                    raise
            with self._stop_over:
                if self._stop_requested:
                    self._stop_over.wait(STOP_OVER_S)

    def _read(self) -> Reading:
        with self._talking() as talk:
            pan, tilt = self._axes["pan"], self._axes["tilt"]
            time_s = measure(talk, pan, tilt, self._clock)
            if self._count.halt_owed:
                self._halt(talk)
            settled = all(axis.settled(self._options.settle_s) for axis in (pan, tilt))
            if settled:  # of a moving head only the place is read
                with suppress(NoReply, BadReply):  # the place is known; the supply is requested again
                    self._supply.check(talk)
            return Reading(pan.angle_rad, tilt.angle_rad, not settled, time_s, self._faults())

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        """Start both axes together towards the nearest positions; a thread carries an approach on.

        Raises OutOfRange for an angle outside the limits, or a speed that is no positive number or below the
        unit's slowest (31 positions/s); nothing moves. Speeds between are rounded down; HardwareFault if the
        unit has lost count of its position; Refused if the unit will not, with its reason; NoReply, BadReply,
        LineLost if it did not confirm; unless only the last step is unconfirmed, nothing moves.
        """
        goals = {"pan": pan_rad, "tilt": tilt_rad}
        limits = [self._axes[name].options.limits_rad for name in goals]
        check_goal((pan_rad, tilt_rad), limits, speed_rad_per_s, DEVICE)
        with self._talking() as talk:
            if self._count.lost:
                raise HardwareFault("; ".join(self._count.lost.values()), device=DEVICE)
            ways = {name: axis.way_to(goals[name]) for name, axis in self._axes.items()}
            speeds = {name: axis.speed_from_rad(speed_rad_per_s) for name, axis in self._axes.items()}
            for name, axis in self._axes.items():
                axis.next_target = None
                self._set_speed(talk, axis, speeds[name])
            talk.request("S")
            for name, (target, _) in ways.items():
                talk.request(f"{name[0].upper()}P{target}")
            if self._count.suspected:
                message = "reported a limit hit while it stood still; it is checked before it moves"
                raise BadReply(message, device=DEVICE)
            if self._stop_requested:
                raise DriverError("a stop came before the move was started", device=DEVICE)
            for name, axis in self._axes.items():
                axis.sent(ways[name][0], self._clock.now_s())
            self._supply.due_s = 0.0  # what the way drew from it is judged where it ends
            talk.request("I")
            for name, axis in self._axes.items():
                axis.next_target = ways[name][1]
            if self._has_legs and not self._finishing:
                self._finishing = True
                self._time.thread(self._finish, f"{DEVICE} approach").start()

    def stop(self) -> None:
        """Halt both axes; they hold where they come to rest, and no second leg of a move follows.

        If another call is under way, anything has to be requested first, or unrequested bytes came, the halt
        goes out at once. A call under way gets the answer that it waits for, and then gives way; where
        anything else comes, the halt goes out again in order. A line that is away is tried at once: a unit
        has no watchdog that silence would trip. Raises NoReply, BadReply, LineLost if the unit did not
        confirm.
        """
        self._stop_requested = True
        free = self._turn.acquire(blocking=False)
        try:
            self._forget_legs()
            in_order = free and self._talk is not None and self._talk.is_in_step and not self._count.suspected
            if not in_order:
                self._halt_beside()
            try:
                self._halt_in_order()
            except BadReply:  # perhaps of unrequested bytes, and nothing was sent yet
                self._halt_beside()
                self._halt_in_order()
        finally:
            self._forget_legs()  # those of a move that was under way beside it, whatever the unit has said
            with self._stop_over:
                self._stop_requested = False
                self._stop_over.notify_all()
            if free:
                self._turn.release()

    def close(self) -> None:
        """Halt, as `stop_at_last`, and let go of the line."""
        with self._turn:
            if not self._closed:
                stop_at_last(self.stop, self._time, DEVICE)
                self._closed = True
                self._drop()

    # The line

    @contextmanager
    def _talking(self, gives_way: bool = True) -> Iterator[Conversation]:
        """The conversation in step, for one caller at a time; a line that turns out dead is closed."""
        with self._turn:
            if self._closed:
                raise NoReply("it is closed", device=DEVICE)
            talk = self._talk or self._connect()
            talk.gives_way = gives_way
            try:
                if self._count.suspected:
                    self._check(talk, talk.in_step())
                    self._count.compare_places(self._axes)
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
        if self._time.now_s() < self._absence.again_s and not self._stop_requested:
            self._absence.check()
        self._deaf = True  # a unit that homes itself at power-up reports its limit switches
        try:
            line = self._open_line(self._options.port, self._options.baud, DEVICE)
            talk = self._talk = Conversation(line, DEVICE, self._hit, self._time)
            talk.send_at_once("H")  # before any question: it may still be under way
            resolutions = talk.in_step()
            self._deaf = False
            self._check(talk, resolutions)
        except DriverError as error:
            self._give_up(error)
            raise
        finally:
            self._deaf = False
        if self._absence.error is not None:
            log.info("%s: the line is back", DEVICE)
        self._absence.end()
        self._silent = 0
        return talk

    def _give_up(self, error: DriverError) -> None:
        """Close the line, and remember why and until when."""
        self._absence.note(error, self._time.now_s())
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
        if changed or (pan.speed is not None and round(talk.value_of(queries.SPEED["pan"])) != pan.speed):
            log.warning("%s: resolution or speed are not as they were; it was reset or restarted", DEVICE)
            self._check(talk, resolutions)

    def _check(self, talk: Conversation, resolutions: Mapping[str, float]) -> None:
        """Make the unit ready, the first time and after it or its line was away. Moves nothing."""
        with talk.patient():
            version = checked_version(talk, self._options, self.version)
            axes = ready_axes(talk, self._options, resolutions, self._axes, self._clock)
            for name, before in self._axes.items():
                self._count.compare(before, axes[name])
            self.version, self._axes = version, axes
            self._supply.begin(talk)

    def _hit(self, axis: str) -> None:
        """The unit reports that an axis ran into its limit switch."""
        if not self._deaf:
            self._count.hit(axis, self._axes)

    # The unit

    @property
    def info(self) -> HeadInfo:
        """How each axis moves: the unit's acceleration when it was made ready, and its approach."""
        motion = {
            name: AxisMotion(
                axis.acceleration * axis.position_rad,
                axis.options.approach_rad,
                axis.options.rising_below_rad,
                axis.position_rad,
            )
            for name, axis in self._axes.items()
        }
        return HeadInfo(stops_beside=True, motion=motion)

    def _set_speed(self, talk: Conversation, axis: StepAxis, speed: int) -> None:
        """Set an axis's speed unless it is set already."""
        if axis.speed != speed:
            axis.speed = None
            talk.request(f"{axis.name[0].upper()}S{speed}")
            axis.speed = speed

    def _halt(self, talk: Conversation) -> None:
        """Halt both axes; a halt that was sent beside another call needs its answer only."""
        if not talk.sent_at_once("H"):
            talk.request("H")
        self._count.halt_owed = False
        for axis in self._axes.values():
            axis.stopped(self._clock.now_s())

    def _halt_beside(self) -> None:
        """Send a halt at once beside whatever is under way, if there is a line."""
        talk = self._talk
        if talk is not None:
            with suppress(LineLost):  # reported by the next request
                talk.send_at_once("H")

    def _halt_in_order(self) -> None:
        """Halt both axes in a conversation that is in step."""
        with self._talking(gives_way=False) as talk:
            self._halt(talk)

    def _forget_legs(self) -> None:
        """Let no axis go on from where an approach begins."""
        for axis in self._axes.values():
            axis.next_target = None

    @property
    def _has_legs(self) -> bool:
        """Whether an axis is on its way to where an approach begins."""
        return any(axis.next_target is not None for axis in self._axes.values())

    def _finish(self) -> None:
        """Send each axis on its last stretch when it is where that begins, whether or not a client reads."""
        while True:
            self._time.sleep(LEG_POLL_S)
            self._leg_due = True
            with self._turn:
                self._leg_due = False
                if self._closed or self._talk is None:  # a line that comes back halts the unit first
                    self._forget_legs()
                elif self._has_legs:
                    try:
                        self._go_on()
                    except DriverError as error:  # a stop came, or the client's next call reports it
                        log.debug("%s: %s", DEVICE, error)
                self._finishing = self._has_legs
                ended = not self._finishing
            with self._stop_over:
                self._stop_over.notify_all()
            if ended:
                return

    def _go_on(self) -> None:
        """Send the axes that are where their approach begins to their goals. Raises DriverError."""
        with self._talking() as talk:
            pan, tilt = self._axes["pan"], self._axes["tilt"]
            since_s = self._clock.now_s() - LEG_POLL_S
            if any(axis.seen is None or axis.seen.time_s < since_s for axis in (pan, tilt)):
                measure(talk, pan, tilt, self._clock)
            for axis in (pan, tilt):
                if axis.next_target is not None and axis.at_target and not self._stop_requested:
                    talk.request(f"{axis.name[0].upper()}P{axis.next_target}")
                    axis.sent(axis.next_target, self._clock.now_s())

    def _faults(self) -> tuple[str, ...]:
        """What is wrong, in sentences."""
        stalls = (axis.stall_fault() for axis in self._axes.values())
        return (*self._count.lost.values(), *self._supply.faults, *(stall for stall in stalls if stall))


def halt(
    options: Mapping[str, Any], clock: Clock | None = None, open_line: OpenLine = SerialLine
) -> list[str]:
    """Halt both axes, and see that the unit took it; it holds where that ends. Sets nothing.

    ``clock`` and ``open_line`` are as of `drivers.flir_ptu.head.open_head`. Raises BadOptions for options
    that cannot be; LineLost, NoReply, BadReply, Refused if it was not confirmed; the command has been sent
    twice all the same, unless the line is lost.
    """
    read = options_from(options)
    with talking(open_line(read.port, read.baud, DEVICE), clock) as talk:
        talk.send_at_once("H")  # before any question
        talk.send_at_once("H")
        talk.in_step()
        talk.request("H")
    return ["pan and tilt halted (H), confirmed"]


DRIVER = Driver(
    lambda options, context: open_head(options, context.clock),
    read_options=options_from, halt=halt, probe=probe, bench=BENCH,
)  # fmt: skip
