"""Driver ``visca``: a pan/tilt head that speaks VISCA, as a `drivers.interfaces.PanTilt`.

It has no thread: a call waits for the head, never longer than a few reply times.

A reply has neither a checksum nor a number. So a position counts when two answers in a row fit one another.
After a reply that was lost, or had not been requested, nothing is asked for `LATE_S`; no reply may be later.
Over UDP frames have numbers, which prove more, and the driver waits for nothing (`drivers.visca.udp`). A head
whose host is gone goes to the end of its move.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from drivers.absent import Absence
from drivers.clock import Clock, ClockLock, SystemClock, deadlines_on
from drivers.errors import BadReply, DriverError, LineLost, NoReply, OutOfRange, Refused, WrongDevice
from drivers.goals import check_goal
from drivers.interfaces import AxisMotion, Reading
from drivers.serial_line import ByteLine, OpenLine, SerialLine
from drivers.visca.options import DEVICE, AxisOptions, ViscaOptions, options_from
from drivers.visca.protocol import (
    ERROR_WORDS,
    FASTEST_CODES,
    Kind,
    go_command,
    kind_of,
    place_inquiry,
    places_of,
    stop_command,
    take_frame,
)
from drivers.visca.udp import UdpLine

log = logging.getLogger(__name__)

LATE_S = 0.7
LISTENS_S = 0.02  # at a time, while late replies are waited out
STUCK_S = 1.0
STANDS_S = 0.2  # for so long it says one place: the slowest code turns by counts meanwhile
LOOK_S = 0.05
BRAKES_WITHIN_S, STOP_TRIES = 2.0, 2
AXES = ("pan", "tilt")


def open_head(
    options: Mapping[str, Any], clock: Clock | None = None, open_line: OpenLine = SerialLine
) -> ViscaHead:
    """Return the open head that the options name; opening stops it and moves nothing.

    Raises
    ------
    BadOptions
        For options that cannot be used.
    LineLost, NoReply, BadReply, WrongDevice
        If the head cannot be reached, or stands outside of its limits.
    """
    return ViscaHead(options_from(options), clock or SystemClock(), open_line)


@dataclass
class _Axis:
    """Where an axis is and where it was sent, counts."""

    options: AxisOptions
    place: int = 0
    since_s: float = -math.inf
    target: int | None = None

    def take(self, place: int, now_s: float) -> None:
        """Take where it is."""
        if place != self.place or self.since_s == -math.inf:
            self.place, self.since_s = place, now_s

    @property
    def arrived(self) -> bool:
        """Whether it is where it was sent, if it was."""
        return self.target is None or abs(self.place - self.target) <= 1


class ViscaHead:
    """An open head; safe to use from any thread."""

    def __init__(self, options: ViscaOptions, clock: Clock, open_line: OpenLine) -> None:
        self._options = options
        self._stamps = clock
        self._time = deadlines_on(clock)
        numbered = options.port.startswith("udp://")
        self._open_line = UdpLine if numbered and open_line is SerialLine else open_line
        self._late_s = 0.0 if numbered else LATE_S
        self._turn = ClockLock(self._time)
        self._absence = Absence()
        self._axes = (_Axis(options.pan), _Axis(options.tilt))
        self._line: ByteLine | None = None
        self._buffer = bytearray()
        self._late_until_s = -math.inf
        self._stops = 0  # asked for so far
        self._closed = False
        self._connect()

    def read(self) -> Reading:
        """Return where the axes are.

        Raises
        ------
        NoReply, BadReply
            If the head is silent, or says what cannot be true.
        LineLost
            If the line is gone; a later call opens it anew.
        """
        with self._talking():
            time_s = self._look()
            now_s = self._time.now_s()
            settled = all(a.arrived and now_s - a.since_s >= self._options.settle_s for a in self._axes)
            pan, tilt = (axis.options.angle_rad(axis.place) for axis in self._axes)
            return Reading(pan, tilt, not settled, time_s, self._faults(now_s))

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        """Start both axes towards the nearest counts, each at the speed asked for or its nearest slower code.

        Raises
        ------
        OutOfRange
            For an angle outside the limits, or a speed that the head does not have; nothing was sent.
        Refused
            If the head will not, in its own words.
        NoReply, BadReply, LineLost
            If it did not confirm; a stop was sent then.
        """
        angles = pan_rad, tilt_rad
        check_goal(angles, [axis.options.limits_rad for axis in self._axes], speed_rad_per_s, DEVICE)
        speed = self._options.speed_rad_per_s if speed_rad_per_s is None else speed_rad_per_s
        goals, codes = [], []
        for name, axis, angle in zip(AXES, self._axes, angles, strict=True):
            step = axis.options.fastest_rad_per_s / FASTEST_CODES[name]
            code = min(FASTEST_CODES[name], math.floor(speed / step + 1e-9))
            if code < 1:
                words = f"speed {speed:g} rad/s is less than the {step:.4f} rad/s of {name}'s slowest code"
                raise OutOfRange(words, device=DEVICE)
            goals.append(axis.options.counts(angle))
            codes.append(code)
        stops = self._stops
        with self._talking():
            address = self._options.address
            try:
                if not all(axis.arrived for axis in self._axes):
                    self._order(stop_command(address))  # a head may keep its first goal otherwise
                if stops != self._stops:
                    raise DriverError("a stop came before the move was started", device=DEVICE)
                self._order(go_command(address, (codes[0], codes[1]), (goals[0], goals[1])))
            except DriverError:
                self._shout()
                raise
            now_s = self._time.now_s()
            for axis, goal in zip(self._axes, goals, strict=True):
                axis.target, axis.since_s = goal, now_s
            if stops != self._stops:  # it went out beside this
                self._forget_targets()

    def stop(self) -> None:
        """Stop both axes and see that they stand; they hold there.

        If another call is under way the command goes out at once, and again in its turn. A line that is away
        is tried at once: no silence stops a head. Raises NoReply, BadReply, Refused, LineLost, WrongDevice if
        the head did not confirm, or still moves.
        """
        self._stops += 1
        if not self._turn.acquire(blocking=False):
            self._shout()
            self._turn.acquire()
        try:
            with self._talking(held=True):
                self._stand()
        finally:
            self._turn.release()

    def close(self) -> None:
        """Stop and let go of the line."""
        with self._turn:
            if self._closed:
                return
            try:
                if self._line is not None:
                    self._stand()
            except DriverError as error:
                log.warning("the last stop was not confirmed: %s", error)
            self._closed = True
            self._drop()

    def axis_motion(self) -> dict[str, AxisMotion]:
        """Return how each axis is taken to move, and its count."""
        acceleration = self._options.acceleration_rad_per_s2
        return {
            name: AxisMotion(acceleration, count_rad=axis.options.count_rad)
            for name, axis in zip(AXES, self._axes, strict=True)
        }

    # The line

    @contextmanager
    def _talking(self, held: bool = False) -> Any:
        """The head, for one caller at a time; a line that turns out dead is closed.

        A stop has ``held`` the turn already, and tries a line that is away at once.
        """
        if not held:
            self._turn.acquire()
        try:
            if self._closed:
                raise NoReply("it is closed", device=DEVICE)
            if self._line is None:
                self._connect(at_once=held)
            yield
        except LineLost as error:
            if self._line is not None:
                self._absence.note(error, self._time.now_s())
                self._drop()
            raise
        finally:
            if not held:
                self._turn.release()

    def _connect(self, at_once: bool = False) -> None:
        """Open the line and stop the head, which may still be under way; not too often, or at once."""
        if not at_once and self._time.now_s() < self._absence.again_s:
            self._absence.check()
        try:
            self._line = self._open_line(self._options.port, self._options.baud, DEVICE)
            self._buffer.clear()
            self._order(stop_command(self._options.address))
            self._look()
            for name, axis in zip(AXES, self._axes, strict=True):
                angle, (low, high) = axis.options.angle_rad(axis.place), axis.options.limits_rad
                if not low - axis.options.count_rad <= angle <= high + axis.options.count_rad:
                    words = (
                        f"{name} stands at {angle:.4f} rad, outside its limits {low:.4f} to {high:.4f} rad"
                    )
                    raise WrongDevice(f"{words}: correct zero_rad, count_rad or limits_rad", device=DEVICE)
        except DriverError as error:
            self._absence.note(error, self._time.now_s())
            self._drop()
            raise
        self._forget_targets()
        self._absence.end()

    def _drop(self) -> None:
        line, self._line = self._line, None
        if line is not None:
            line.close()

    def _shout(self) -> None:
        """Send a stop at once, whatever is under way, if there is a line."""
        line = self._line
        if line is not None:
            with suppress(LineLost):
                line.write(2 * stop_command(self._options.address))

    # The head

    def _look(self) -> float:
        """Ask where the axes are, two times; returns when that was. Raises NoReply, BadReply, LineLost."""
        question = place_inquiry(self._options.address)
        began_s = self._time.now_s()
        before = places_of(self._ask(question, Kind.PLACE))
        asked_s = self._time.now_s()
        now = places_of(self._ask(question, Kind.PLACE))
        ended_s = self._time.now_s()
        for name, axis, one, two in zip(AXES, self._axes, before, now, strict=True):
            most = 2 + axis.options.fastest_rad_per_s * (ended_s - began_s) / axis.options.count_rad
            if abs(two - one) > most:
                self._late_until_s = ended_s + self._late_s
                raise BadReply(
                    f"{name} says {one} and then {two} counts: one of them is wrong", device=DEVICE
                )
        for axis, place in zip(self._axes, now, strict=True):
            axis.take(place, ended_s)
        return self._stamps.now_s() - (ended_s - asked_s) / 2

    def _order(self, command: bytes) -> None:
        """Send a command and wait for its acknowledgement. Raises NoReply, Refused, LineLost."""
        self._ask(command, Kind.ACK, patient=True)

    def _stand(self) -> None:
        """Stop, and look whether the head stands: an acknowledgement may be that of an order before.

        Raises NoReply, Refused, LineLost.
        """
        for left in reversed(range(STOP_TRIES)):
            try:
                self._order(stop_command(self._options.address))
            except (NoReply, Refused):
                if not left:
                    raise
                continue
            self._forget_targets()
            until_s = self._time.now_s() + BRAKES_WITHIN_S
            while (asked_s := self._time.now_s()) < until_s:
                with suppress(NoReply, BadReply):  # late replies are waited out here
                    self._look()
                    if all(asked_s - axis.since_s >= STANDS_S for axis in self._axes):
                        return
                    self._time.sleep(LOOK_S)
        raise NoReply("the head acknowledged the stop, and still moves or does not say", device=DEVICE)

    def _ask(self, frame: bytes, wanted: Kind, patient: bool = False) -> bytes:
        """Send a frame and return the reply; ``patient`` where a late one of another kind does no harm."""
        line = self._line
        assert line is not None
        self._receive(line, 0.0)
        while (found := take_frame(self._buffer)) is not None:
            if kind_of(found, self._options.address) not in (Kind.ACK, Kind.DONE):
                self._late_until_s = self._time.now_s() + self._late_s
        if not patient and (left_s := self._late_until_s - self._time.now_s()) > 0:
            self._receive(line, min(left_s, LISTENS_S))
            raise NoReply(f"late replies are waited out for {left_s:.2f} s", device=DEVICE)
        line.write(frame)
        wire_s = (len(frame) + 11) * line.byte_s
        until_s = self._time.now_s() + self._options.reply_timeout_s + wire_s
        while (left_s := until_s - self._time.now_s()) > 0:
            self._receive(line, left_s)
            while (found := take_frame(self._buffer)) is not None:
                kind = kind_of(found, self._options.address)
                if kind is wanted:
                    return found
                if kind is Kind.ERROR and wanted is Kind.ACK:
                    words = ERROR_WORDS.get(found[2], f"error 0x{found[2]:02x}")
                    raise Refused(f"the head refuses: {words}", device=DEVICE)
                if kind in (Kind.OTHER, Kind.ERROR) and not patient:
                    self._late_until_s = self._time.now_s() + self._late_s
                    raise BadReply(f"answered with {found.hex(' ')}", device=DEVICE)
        self._late_until_s = self._time.now_s() + self._late_s
        words = f"no {wanted.value} within {self._options.reply_timeout_s:g} s on {self._options.port}"
        raise NoReply(words, device=DEVICE)

    def _receive(self, line: ByteLine, wait_s: float) -> None:
        self._buffer += line.read(max(0.0, wait_s))

    def _forget_targets(self) -> None:
        """Let the axes stand wherever they come to rest."""
        now_s = self._time.now_s()
        for axis in self._axes:
            axis.target, axis.since_s = None, now_s

    def _faults(self, now_s: float) -> tuple[str, ...]:
        """What is wrong, in plain words."""
        words = []
        for name, axis in zip(AXES, self._axes, strict=True):
            if axis.target is not None and not axis.arrived and now_s - axis.since_s > STUCK_S:
                left_rad = abs(axis.target - axis.place) * axis.options.count_rad
                words.append(f"{name} stands still {left_rad:.4f} rad from its goal: something holds it")
        return tuple(words)


def halt(
    options: Mapping[str, Any], clock: Clock | None = None, open_line: OpenLine = SerialLine
) -> list[str]:
    """Stop both axes, and see that they stand; the head holds where that ends.

    Raises
    ------
    BadOptions
        For options that cannot be.
    LineLost, NoReply, BadReply, Refused, WrongDevice
        If it was not confirmed; the command has been sent all the same, unless the line is lost.
    """
    head = ViscaHead(options_from(options), clock or SystemClock(), open_line)
    try:
        head.stop()
    finally:
        head.close()
    return ["pan and tilt stopped, confirmed"]
