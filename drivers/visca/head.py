"""Driver ``visca``: a pan/tilt head that speaks VISCA, as a `drivers.interfaces.PanTilt`.

A reply has neither a checksum nor a number. So a position counts when two answers in a row fit one another.
Over UDP frames have numbers, which prove more, and the driver waits for nothing (`drivers.visca.udp`). A head
whose host is gone goes to the end of its move.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from drivers.errors import BadReply, DriverError, OutOfRange, Refused
from drivers.goals import check_goal
from drivers.ptz.head import AXES, PtzAxis, PtzHead
from drivers.ptz.options import PtzOptions
from drivers.serial_line import SerialLine
from drivers.visca.options import DEVICE, options_from
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


class ViscaHead(PtzHead):
    """An open head, as `PtzHead`."""

    _device = DEVICE

    def _read(self, options: Mapping[str, Any]) -> tuple[PtzOptions, Sequence[PtzAxis]]:
        read = options_from(options)
        if read.port.startswith("udp://"):
            self._late_s = 0.0
            if self._open_line is SerialLine:
                self._open_line = UdpLine
        return read, [PtzAxis(axis, axis.count_rad) for axis in (read.pan, read.tilt)]

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
            try:
                if not all(axis.arrived for axis in self._axes):
                    self._order_stop(False)  # a head may keep its first goal otherwise
                if stops != self._stops:
                    raise DriverError("a stop came before the move was started", device=DEVICE)
                go = go_command(self._options.address, (codes[0], codes[1]), (goals[0], goals[1]))
                self._ask(go, Kind.ACK, patient=True)
            except DriverError:
                self._shout()
                raise
            now_s = self._time.now_s()
            for axis, goal in zip(self._axes, goals, strict=True):
                axis.target, axis.since_s = goal, now_s
            if stops != self._stops:  # it went out beside this
                self._forget_targets()

    def _stop_frame(self) -> bytes:
        return stop_command(self._options.address)

    def _order_stop(self, again: bool) -> None:
        self._ask(self._stop_frame(), Kind.ACK, patient=True)

    def _look(self) -> float:
        question = place_inquiry(self._options.address)
        began_s = self._time.now_s()
        before = places_of(self._ask(question, Kind.PLACE))
        asked_s = self._time.now_s()
        now = places_of(self._ask(question, Kind.PLACE))
        ended_s = self._time.now_s()
        self._check_agree(before, now, ended_s - began_s)
        for axis, place in zip(self._axes, now, strict=True):
            axis.take(place, ended_s)
        return self._stamps.now_s() - (ended_s - asked_s) / 2

    def _ask(self, frame: bytes, wanted: Kind, patient: bool = False) -> bytes:
        """Send a frame and return the reply; ``patient`` where a late one of another kind does no harm."""
        line = self._line
        assert line is not None
        self._receive(line, 0.0)
        while (found := take_frame(self._buffer)) is not None:
            if kind_of(found, self._options.address) not in (Kind.ACK, Kind.DONE):
                self._astray()
        if not patient:
            self._wait_out(line)
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
                    self._astray()
                    raise BadReply(f"answered with {found.hex(' ')}", device=DEVICE)
        raise self._no_reply(wanted.value)


open_head, halt = ViscaHead, ViscaHead.halt
