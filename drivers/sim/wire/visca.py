"""A simulated VISCA head on a line, from Sony's command lists; the driver's frames are its own.

Assumed, since no list states it: what it needs to answer, that a new position command replaces the one under
way, and that its speed codes are shares of the fastest.
"""

from __future__ import annotations

from collections.abc import Sequence

from drivers.sim.wire.axis import WireAxis
from drivers.sim.wire.carrier import Reply

ANSWER_S = 0.002
_SYNTAX, _NOT_EXECUTABLE = 0x02, 0x41


class SimulatedVisca:
    """A head, a ``WireDevice``.

    Parameters
    ----------
    pan, tilt
        What it turns.
    count_rad
        One count of both.
    fastest_rad_per_s
        Of speed code 24 of pan and 20 of tilt.
    limits
        Lowest and highest position of pan and tilt that it takes.
    address, baud
        Of its serial line.
    """

    def __init__(
        self,
        pan: WireAxis,
        tilt: WireAxis,
        *,
        count_rad: float,
        fastest_rad_per_s: float,
        limits: tuple[tuple[int, int], tuple[int, int]] = ((-0x7FFF, 0x7FFF), (-0x7FFF, 0x7FFF)),
        address: int = 1,
        baud: int = 9600,
    ) -> None:
        self.axes = (pan, tilt)
        self.baud = baud
        self._count_rad = count_rad
        self._steps = (fastest_rad_per_s / 24, fastest_rad_per_s / 20)
        self._limits = limits
        self._address = address
        self._received = bytearray()
        self._under_way: list[int] = []  # sockets whose completion is owed

    def receive(self, data: bytes, time_s: float) -> Sequence[Reply]:
        """Take bytes and answer the frames that are complete."""
        self._received += data
        replies: list[Reply] = []
        while (end := self._received.find(b"\xff")) >= 0:
            frame = bytes(self._received[:end])
            del self._received[: end + 1]
            if frame and frame[0] == 0x80 | self._address and not self._dead(time_s):
                replies += [Reply(self._framed(*body), ANSWER_S) for body in self._answer(frame[1:], time_s)]
        del self._received[:-16]
        return replies

    def poll(self, time_s: float) -> Sequence[Reply]:
        """Return the completion of a move that has ended."""
        for axis in self.axes:
            axis.follow(time_s)
        if self._under_way and not any(axis.under_way(time_s) or axis.blocked(time_s) for axis in self.axes):
            sockets, self._under_way = self._under_way, []
            return [Reply(self._framed(0x50 | socket), ANSWER_S) for socket in sockets]
        return ()

    def _framed(self, *body: int) -> bytes:
        return bytes((0x80 + 16 * self._address, *body, 0xFF))

    def _dead(self, time_s: float) -> bool:
        return all(axis.silent(time_s) for axis in self.axes)

    def _answer(self, body: bytes, time_s: float) -> list[tuple[int, ...]]:
        """Carry out one frame; returns what it answers."""
        if body == b"\x09\x06\x12":
            digits: list[int] = []
            for axis in self.axes:
                place = round(axis.angle_rad(time_s) / self._count_rad)
                word = max(-0x8000, min(0x7FFF, place)) & 0xFFFF
                digits += [word >> shift & 15 for shift in (12, 8, 4, 0)]
            return [(0x50, *digits)]
        if body == b"\x09\x04\x00":
            return [(0x50, 0x02)]
        if body[:3] == b"\x01\x06\x01" and len(body) == 7:
            return self._drive(body[3:], time_s)
        if body[:3] == b"\x01\x06\x02" and len(body) == 13:
            return self._go(body[3:], time_s)
        return [(0x60, _SYNTAX)]

    def _drive(self, body: bytes, time_s: float) -> list[tuple[int, ...]]:
        """Turn at a speed, or stop."""
        signs = ({1: -1, 2: 1, 3: 0}.get(body[2]), {1: 1, 2: -1, 3: 0}.get(body[3]))
        for axis, sign, code, step in zip(self.axes, signs, body[:2], self._steps, strict=True):
            if sign is None:
                return [(0x60, _SYNTAX)]
            axis.velocity(time_s, sign * code * step, axis.settings.acceleration_rad_per_s2)
        self._under_way = []
        return [(0x41,), (0x51,)]

    def _go(self, body: bytes, time_s: float) -> list[tuple[int, ...]]:
        """Go to a position."""
        places = []
        for at, (low, high) in zip((2, 6), self._limits, strict=True):
            word = sum(digit << shift for digit, shift in zip(body[at : at + 4], (12, 8, 4, 0), strict=True))
            place = word - 0x10000 if word & 0x8000 else word
            if not low <= place <= high:
                return [(0x61, _NOT_EXECUTABLE)]
            places.append(place)
        for axis, place, code, step in zip(self.axes, places, body[:2], self._steps, strict=True):
            steep = axis.settings.acceleration_rad_per_s2
            axis.goal(time_s, place * self._count_rad, max(1, code) * step, steep)
        self._under_way = [1]
        return [(0x41,)]
