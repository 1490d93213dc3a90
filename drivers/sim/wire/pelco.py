"""A simulated Pelco-D or Pelco-P head on a line, from makers' command lists; the driver's frames are its own.

Assumed, since no list states it: what it needs to answer, that a new position replaces the one under way, and
that it takes the shortest way there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

from drivers.sim.wire.axis import WireAxis
from drivers.sim.wire.carrier import Reply

ANSWER_S = 0.002
_PER_RAD, _AROUND = 18000 / math.pi, 36000  # hundredths of a degree
_JOG = {0x02: (0, 1), 0x04: (0, -1), 0x08: (1, 1), 0x10: (1, -1)}  # right, left, up, down: axis and sign
_FASTEST_JOG = 0x3F


class SimulatedPelco:
    """A head, a ``WireDevice``.

    Parameters
    ----------
    pan, tilt
        What it turns.
    fastest_rad_per_s
        On the way to a position, and of a jog's highest speed.
    protocol
        ``D`` or ``P``.
    acknowledges
        Whether it gives the general response of Pelco-D (four bytes) to commands that ask nothing.
    address, baud
        Of its serial line.
    """

    def __init__(
        self,
        pan: WireAxis,
        tilt: WireAxis,
        *,
        fastest_rad_per_s: float,
        protocol: Literal["D", "P"] = "D",
        acknowledges: bool = False,
        address: int = 1,
        baud: int = 9600,
    ) -> None:
        self.axes = (pan, tilt)
        self.baud = baud
        self._fastest = fastest_rad_per_s
        self._is_d = protocol == "D"
        self._acknowledges = acknowledges
        self._own = address if self._is_d else address - 1
        self._received = b""

    def receive(self, data: bytes, time_s: float) -> Sequence[Reply]:
        """Take bytes and answer the frames that are complete."""
        self._received += data
        first, size = (b"\xff", 7) if self._is_d else (b"\xa0", 8)
        replies: list[Reply] = []
        while (start := self._received.find(first)) >= 0 and len(self._received) >= start + size:
            one = self._received[start : start + size]
            good = self._framed(one[1], *one[2:6]) == one
            self._received = self._received[start + (size if good else 1) :]
            if good and one[1] == self._own and not all(axis.silent(time_s) for axis in self.axes):
                replies += [Reply(answer, ANSWER_S) for answer in self._carry_out(one, time_s)]
        return replies

    def poll(self, time_s: float) -> Sequence[Reply]:
        """Let faults act; it sends nothing by itself."""
        for axis in self.axes:
            axis.follow(time_s)
        return ()

    def _framed(self, *body: int) -> bytes:
        if self._is_d:
            return bytes((0xFF, *body, sum(body) % 256))
        check = 0xA0 ^ 0xAF
        for byte in body:
            check ^= byte
        return bytes((0xA0, *body, 0xAF, check))

    def _carry_out(self, one: bytes, time_s: float) -> list[bytes]:
        """Do what a frame of this head says; returns what it answers."""
        code, value = one[3], one[4] * 256 + one[5]
        if code in (0x51, 0x53):
            axis = self.axes[(code - 0x51) // 2]
            place = round(axis.angle_rad(time_s) * _PER_RAD) % _AROUND
            return [self._framed(self._own, 0, code + 8, *divmod(place, 256))]
        if code in (0x4B, 0x4D):
            axis = self.axes[(code - 0x4B) // 2]
            here = axis.motion.at(time_s)[0] * _PER_RAD
            way = (value - here + _AROUND / 2) % _AROUND - _AROUND / 2
            axis.goal(time_s, (here + way) / _PER_RAD, self._fastest, axis.settings.acceleration_rad_per_s2)
        elif code % 2 == 0:
            self._jog(code, one[4:6], time_s)
        return [bytes((0xFF, self._own, 0, self._own))] if self._acknowledges and self._is_d else []

    def _jog(self, code: int, speeds: bytes, time_s: float) -> None:
        """Turn at speeds, or stop."""
        wanted = [0.0, 0.0]
        for bit, (number, sign) in _JOG.items():
            if code & bit:
                wanted[number] = sign * min(speeds[number], _FASTEST_JOG) / _FASTEST_JOG * self._fastest
        for axis, speed in zip(self.axes, wanted, strict=True):
            axis.velocity(time_s, speed, axis.settings.acceleration_rad_per_s2)
