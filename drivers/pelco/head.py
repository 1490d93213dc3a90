"""Driver ``pelco``: a pan/tilt head that speaks Pelco-D or Pelco-P, as a `drivers.interfaces.PanTilt`.

No command sets the speed of the way to a position. So a move goes in steps, and each reading sends the next
one. It is as long as the speed asked for allows since the last, and never ends further than ``step_rad`` from
where the axis is. The mean speed is never more than asked; within a step the head's own counts. A head whose
host is gone, or hangs, stands after the step under way.

A reply has a checksum and no number. It counts when it was asked for, came in time on an emptied line, and is
not further from the last position than the axis can turn. After a loss two answers have to fit one another.
Pan and tilt are asked one after the other; a reading's stamp is the middle between them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from drivers.errors import BadReply, DriverError
from drivers.goals import check_goal
from drivers.pelco.options import DEVICE, PelcoAxisOptions, PelcoOptions, options_from
from drivers.pelco.protocol import ASK, LENGTH, SET, STOP, TOLD, TURN, frame, take_answer
from drivers.ptz.head import AXES, PtzAxis, PtzHead

AGAIN_S = 0.25  # a position is sent again while the axis is not there: nothing says that it arrived


class _Axis(PtzAxis):
    """An axis under way in steps.

    Attributes
    ----------
    goal
        How far its move has come, counts; a position between two of them is on its way to the next.
    sent, sent_s
        The position sent last, and when.
    """

    def __init__(self, options: PelcoAxisOptions) -> None:
        super().__init__(options, options.resolution_rad, slack=options.slack, near=options.slack)
        self.unwrapped = options.unwrapped
        self.goal = 0.0
        self.sent: int | None = None
        self.sent_s = -math.inf

    def begin(self, target: int, now_s: float) -> None:
        """Begin a move from where it is."""
        self.target, self.since_s, self.goal, self.sent = target, now_s, float(self.place), None

    def next_place(self, way: float, step: float, now_s: float) -> int | None:
        """Return what to send when the move may go on by ``way``, counts; None: nothing."""
        if self.target is None:
            return None
        left = self.target - self.goal
        goal = self.goal + math.copysign(min(way, abs(left)), left)
        self.goal = min(max(goal, self.place - step), self.place + step)
        place = round(self.goal)
        if place == self.sent and (self.arrived or now_s - self.sent_s < AGAIN_S):
            return None
        self.sent, self.sent_s = place, now_s
        return place


class PelcoHead(PtzHead):
    """An open head, as `PtzHead`. A move goes on only while the head is read."""

    _device, _scale = DEVICE, "sign"

    def _read(self, options: Mapping[str, Any]) -> tuple[PelcoOptions, Sequence[PtzAxis]]:
        read = options_from(options)
        self._protocol, self._step_rad = read.protocol, read.step_rad
        both = (read.pan, read.tilt)
        self._limits = [sorted(axis.counts(angle) for angle in axis.limits_rad) for axis in both]
        self._steps = [_Axis(axis) for axis in both]
        self._speed_rad_per_s = read.speed_rad_per_s
        self._stepped_s = self._looked_s = -math.inf
        self._first = 0  # the axis asked for first, next time
        self._sure = False  # whether the positions known now were proved
        return read, self._steps

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        """Begin the way of both axes to the nearest positions, at no more than the speed asked for as a mean.

        Each later reading sends a step of it.

        Raises
        ------
        OutOfRange
            For an angle outside the limits, or a speed that is none; nothing was sent.
        NoReply, BadReply, LineLost
            If the head does not say where it is; a stop was sent then.
        """
        angles = pan_rad, tilt_rad
        check_goal(angles, [axis.options.limits_rad for axis in self._axes], speed_rad_per_s, DEVICE)
        speed = self._options.speed_rad_per_s if speed_rad_per_s is None else speed_rad_per_s
        goals = [axis.options.counts(angle) for axis, angle in zip(self._axes, angles, strict=True)]
        stops = self._stops
        with self._talking():
            try:
                self._look()
                if stops != self._stops:
                    raise DriverError("a stop came before the move was started", device=DEVICE)
            except DriverError:
                self._forget_targets()
                self._shout()
                raise
            now_s = self._time.now_s()
            self._speed_rad_per_s, self._stepped_s = speed, now_s
            for axis, goal in zip(self._steps, goals, strict=True):
                axis.begin(goal, now_s)

    def _advance(self) -> None:
        now_s = self._time.now_s()
        elapsed_s, self._stepped_s = now_s - self._stepped_s, now_s
        stops, frames = self._stops, b""
        for axis, limits, command in zip(self._steps, self._limits, SET, strict=True):
            unit_rad = axis.options.count_rad
            place = axis.next_place(
                min(self._speed_rad_per_s * elapsed_s, self._step_rad) / unit_rad,
                self._step_rad / unit_rad,
                now_s,
            )
            if place is not None:
                frames += self._frame(command, min(max(place, limits[0]), limits[1]) % TURN)
        line = self._line
        if frames and line is not None and stops == self._stops:
            line.write(frames)

    def _frame(self, command: int, value: int = 0) -> bytes:
        return frame(self._protocol, self._options.address, command, value)

    def _stop_frame(self) -> bytes:
        return self._frame(STOP)

    def _order_stop(self, again: bool) -> None:
        """Stop; where that did not help, send the axes to where they are, which a head may obey."""
        line = self._line
        assert line is not None
        frames = self._stop_frame()
        if again:
            for axis, limits, command in zip(self._axes, self._limits, SET, strict=True):
                frames += self._frame(command, min(max(axis.place, limits[0]), limits[1]) % TURN)
        line.write(frames)

    def _drop(self) -> None:
        super()._drop()
        self._sure = False

    def _astray(self) -> None:
        super()._astray()
        self._sure = False

    def _look(self) -> float:
        began_s = self._time.now_s()
        places = self._ask_both()
        ended_s = self._time.now_s()
        if not self._sure or not self._fits(places, ended_s - self._looked_s):
            first_s, first, began_s = began_s, places, ended_s
            places = self._ask_both()
            ended_s = self._time.now_s()
            self._check_agree(first, places, ended_s - first_s)
        self._sure, self._looked_s = True, began_s
        for axis, place in zip(self._axes, places, strict=True):
            axis.take(place, ended_s)
        return self._stamps.now_s() - (ended_s - began_s) / 2

    def _fits(self, places: list[int], elapsed_s: float) -> bool:
        """Whether both axes can have come there from where they were."""
        return all(
            abs(place - axis.place) <= self._most(axis, elapsed_s)
            for axis, place in zip(self._axes, places, strict=True)
        )

    def _ask_both(self) -> list[int]:
        """Ask for both axes; the order turns each time. Raises NoReply, BadReply, LineLost.

        So no two questions with one between them are for the same axis: an answer that comes that much late,
        each time, is of the wrong axis.
        """
        first = self._first
        self._first = 1 - first
        places = {number: self._ask(number) for number in (first, 1 - first)}
        return [places[0], places[1]]

    def _ask(self, number: int) -> int:
        """Ask where an axis is; a reply that fits no question makes the next ones wait."""
        line = self._line
        assert line is not None
        self._receive(line, 0.0)
        while take_answer(self._protocol, self._options.address, self._buffer) is not None:
            self._astray()
        self._buffer.clear()
        self._wait_out(line)
        line.write(self._frame(ASK[number]))
        wire_s = 2 * LENGTH[self._protocol] * line.byte_s
        until_s = self._time.now_s() + self._options.reply_timeout_s + wire_s
        while (left_s := until_s - self._time.now_s()) > 0:
            self._receive(line, left_s)
            found = take_answer(self._protocol, self._options.address, self._buffer)
            if found is None:
                continue
            command, value = found
            if command != TOLD[number] or value >= TURN:
                self._astray()
                words = f"asked for {AXES[number]} it answered with 0x{command:02x} and {value}"
                most = f", where 0x{TOLD[number]:02x} and 0 to {TURN - 1} are expected"
                raise BadReply(words + most, device=DEVICE)
            return self._steps[number].unwrapped(value)
        raise self._no_reply(f"{AXES[number]} position")


open_head, halt = PelcoHead, PelcoHead.halt
