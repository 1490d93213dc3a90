"""The base of such heads: the line, one caller at a time, a stop that looks, and axes that stand or do not.

It has no thread: a call waits for the head, never longer than a few reply times. Nothing numbers a reply. So
after one that was lost, or had not been requested, nothing is asked for `LATE_S`; no reply may be later.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from drivers.absent import Absence, stop_at_last
from drivers.clock import Clock, ClockLock, SystemClock, deadlines_on
from drivers.errors import BadReply, DriverError, LineLost, NoReply, Refused, WrongDevice
from drivers.interfaces import AxisMotion, Reading
from drivers.ptz.options import AxisOptions, PtzOptions
from drivers.serial_line import ByteLine, OpenLine, SerialLine

LATE_S = 0.7
LISTENS_S = 0.02  # at a time, while late replies are waited out
STUCK_S = 1.0
STANDS_S = 0.2  # for so long it says one place: the slowest code turns by counts meanwhile
LOOK_S = 0.05
BRAKES_WITHIN_S, STOP_TRIES = 2.0, 2
AXES = ("pan", "tilt")


@dataclass
class PtzAxis:
    """Where an axis is and where it was sent, counts.

    Attributes
    ----------
    slack
        By how much its place may change while it stands.
    near
        How near to its target it counts as arrived.
    count_rad
        The count that is reported.
    since_s
        Since when it stands.
    """

    options: AxisOptions
    count_rad: float
    slack: int = 0
    near: int = 1
    place: int = 0
    since_s: float = -math.inf
    target: int | None = None
    _stood_at: int = 0

    def take(self, place: int, now_s: float) -> None:
        """Take where it is."""
        self.place = place
        if abs(place - self._stood_at) > self.slack or self.since_s == -math.inf:
            self._stood_at, self.since_s = place, now_s

    @property
    def angle_rad(self) -> float:
        """Where it is."""
        return self.options.angle_rad(self.place)

    @property
    def arrived(self) -> bool:
        """Whether it is where it was sent, if it was."""
        return self.target is None or abs(self.place - self.target) <= self.near


class PtzHead(ABC):
    """An open head; safe to use from any thread. Opening stops it and moves nothing.

    Parameters
    ----------
    options
        As a configuration holds them.
    clock, open_line
        What it lives on.

    Raises
    ------
    BadOptions
        For options that cannot be used.
    LineLost, NoReply, BadReply, Refused, WrongDevice
        If the head cannot be reached, or stands outside of its limits.
    """

    def __init__(
        self, options: Mapping[str, Any], clock: Clock | None = None, open_line: OpenLine = SerialLine
    ) -> None:
        self._stamps = clock or SystemClock()
        self._time = deadlines_on(self._stamps)
        self._open_line = open_line
        self._late_s = LATE_S  # how long nothing is asked after a reply went astray
        self._options, self._axes = self._read(options)
        self._turn = ClockLock(self._time)
        self._absence = Absence()
        self._line: ByteLine | None = None
        self._buffer = bytearray()
        self._late_until_s = -math.inf
        self._stops = 0  # asked for so far
        self._closed = False
        self._connect()

    @classmethod
    def halt(
        cls, options: Mapping[str, Any], clock: Clock | None = None, open_line: OpenLine = SerialLine
    ) -> list[str]:
        """Stop both axes, and see that they stand; the head holds where that ends.

        Raises
        ------
        BadOptions
            For options that cannot be.
        LineLost, NoReply, BadReply, Refused, WrongDevice
            If it was not confirmed; the command has been sent all the same, unless the line is lost.
        """
        head = cls(options, clock, open_line)
        try:
            head.stop()
        finally:
            head.close()
        return ["pan and tilt stopped, confirmed"]

    _device = ""
    """Its driver's name in errors."""

    @abstractmethod
    def _read(self, options: Mapping[str, Any]) -> tuple[PtzOptions, Sequence[PtzAxis]]:
        """Read the options, and return its axes by them. Raises BadOptions."""

    @abstractmethod
    def _look(self) -> float:
        """Take where the axes are; returns when that was. Raises NoReply, BadReply, LineLost."""

    @abstractmethod
    def _order_stop(self, again: bool) -> None:
        """Stop both axes; ``again`` where they went on after the first. Raises NoReply, Refused, LineLost."""

    @abstractmethod
    def _stop_frame(self) -> bytes:
        """Return the command that stops both axes."""

    def _advance(self) -> None:  # noqa: B027 - few heads need it
        """Send what keeps a move under way, after each look."""

    def read(self) -> Reading:
        """Return where the axes are.

        Raises
        ------
        NoReply, BadReply
            If the head is silent, or says what cannot be true.
        LineLost
            If the line is gone; a later call opens it anew.
        """
        stops = self._stops
        with self._talking():
            time_s = self._look()
            if stops == self._stops:  # else its command has gone out already
                self._advance()
            now_s = self._time.now_s()
            settled = all(a.arrived and now_s - a.since_s >= self._options.settle_s for a in self._axes)
            pan, tilt = (axis.angle_rad for axis in self._axes)
            return Reading(pan, tilt, not settled, time_s, self._faults(now_s))

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
        """Stop, as `stop_at_last`, and let go of the line."""
        with self._turn:
            if not self._closed:
                stop_at_last(self.stop, self._time, self._device)
                self._closed = True
                self._drop()

    def axis_motion(self) -> dict[str, AxisMotion]:
        """Return how each axis is taken to move, and its count."""
        acceleration = self._options.acceleration_rad_per_s2
        return {
            name: AxisMotion(acceleration, count_rad=axis.count_rad)
            for name, axis in zip(AXES, self._axes, strict=True)
        }

    @contextmanager
    def _talking(self, held: bool = False) -> Iterator[None]:
        """The head, for one caller at a time; a line that turns out dead is closed.

        A stop has ``held`` the turn already, and tries a line that is away at once.
        """
        if not held:
            self._turn.acquire()
        try:
            if self._closed:
                raise NoReply("it is closed", device=self._device)
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
            self._line = self._open_line(self._options.port, self._options.baud, self._device)
            self._buffer.clear()
            self._order_stop(False)
            self._look()
            for name, axis in zip(AXES, self._axes, strict=True):
                angle, (low, high) = axis.angle_rad, axis.options.limits_rad
                if not low - axis.count_rad <= angle <= high + axis.count_rad:
                    words = (
                        f"{name} stands at {angle:.4f} rad, outside its limits {low:.4f} to {high:.4f} rad"
                    )
                    remedy = f"correct zero_rad, {self._scale} or limits_rad"
                    raise WrongDevice(f"{words}: {remedy}", device=self._device)
        except DriverError as error:
            self._absence.note(error, self._time.now_s())
            self._drop()
            raise
        self._forget_targets()
        self._absence.end()

    _scale = "count_rad"  # the option by which a head's positions are angles

    def _drop(self) -> None:
        line, self._line = self._line, None
        if line is not None:
            line.close()

    def _shout(self) -> None:
        """Send a stop at once, whatever is under way, if there is a line."""
        line = self._line
        if line is not None:
            with suppress(LineLost):
                line.write(2 * self._stop_frame())

    def _stand(self) -> None:
        """Stop, and look whether the head stands: nothing else proves that it obeyed.

        Raises NoReply, Refused, LineLost.
        """
        for left in reversed(range(STOP_TRIES)):
            try:
                self._order_stop(left < STOP_TRIES - 1)
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
        raise NoReply(
            "the head got the command to stop, and still moves or does not say", device=self._device
        )

    def _wait_out(self, line: ByteLine) -> None:
        """Refuse to ask while a late reply may come. Raises NoReply."""
        if (left_s := self._late_until_s - self._time.now_s()) > 0:
            self._receive(line, min(left_s, LISTENS_S))
            raise NoReply(f"late replies are waited out for {left_s:.2f} s", device=self._device)

    def _astray(self) -> None:
        """Note that a reply was lost, or came unasked."""
        self._late_until_s = self._time.now_s() + self._late_s

    def _no_reply(self, wanted: str) -> NoReply:
        """Note that a reply was lost; returns the error."""
        self._astray()
        words = f"no {wanted} within {self._options.reply_timeout_s:g} s on {self._options.port}"
        return NoReply(words, device=self._device)

    def _check_agree(self, before: Sequence[int], now: Sequence[int], elapsed_s: float) -> None:
        """Pass two answers that fit one another, so long apart. Raises BadReply."""
        for name, axis, one, two in zip(AXES, self._axes, before, now, strict=True):
            if abs(two - one) > self._most(axis, elapsed_s):
                self._astray()
                raise BadReply(
                    f"{name} says {one} and then {two} counts: one of them is wrong", device=self._device
                )

    @staticmethod
    def _most(axis: PtzAxis, elapsed_s: float) -> float:
        """How far an axis can turn in this time, counts."""
        return 2 + axis.options.fastest_rad_per_s * elapsed_s / axis.options.count_rad

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
