"""Faults of a line: what becomes of a device's replies on their way to the host."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from drivers.faults import PAN_TILT, Fault, FaultPanel
from drivers.sim.wire.dynamixel_packets import renamed

MOST_NOISE = 12
"""The longest garbage in front of a reply, bytes."""


@dataclass(frozen=True)
class Reply:
    """Bytes that a simulated device sends, a whole packet or line of text.

    Attributes
    ----------
    data
        The bytes as they leave the device.
    delay_s
        From the end of what it answers: of the received packet, or of the reply before it in the sequence.
    sender
        The servo's id; 0 for a pan/tilt unit.
    """

    data: bytes
    delay_s: float = 0.0
    sender: int = 0


@dataclass(frozen=True)
class Sent:
    """Bytes as they go out.

    Attributes
    ----------
    data, delay_s
        As of ``Reply``.
    late_s
        By how much the host gets them late; the line is free meanwhile.
    """

    data: bytes
    delay_s: float
    late_s: float = 0.0


class LineFaults:
    """The faults of one line, asked of a panel; without a panel there are none."""

    def __init__(self, panel: FaultPanel | None) -> None:
        self._panel = panel
        self._held: list[Sent] = []  # a reply that waits to change places with the next one

    def hung_up(self, time_s: float) -> bool:
        """Return whether the cable is pulled."""
        return self._panel is not None and self._panel.find(PAN_TILT, "hang_up", time_s) is not None

    def deaf(self, time_s: float) -> bool:
        """Return whether the device has no power to hear anything."""
        return self._panel is not None and self._panel.find(PAN_TILT, "off", time_s) is not None

    def apply(self, replies: Sequence[Reply], time_s: float) -> list[Sent]:
        """Return what goes out for the replies of one moment, in this order."""
        panel = self._panel
        if panel is None:
            return [Sent(reply.data, reply.delay_s) for reply in replies]
        sent: list[Sent] = []
        for reply in replies:
            if self.deaf(time_s) or panel.strikes(PAN_TILT, time_s):
                continue
            if panel.takes(PAN_TILT, "mute", time_s, reply.sender):
                continue
            one = self._damaged(panel, reply, time_s)
            if not self._held and panel.takes(PAN_TILT, "swapped", time_s, reply.sender):
                self._held = [one]
                continue
            sent += [one, *self._held]
            self._held = []
            if panel.takes(PAN_TILT, "duplicate", time_s, reply.sender):
                sent.append(replace(one, delay_s=0.0))
        return sent

    def _damaged(self, panel: FaultPanel, reply: Reply, time_s: float) -> Sent:
        """A reply of another sender, with a wrong byte, cut short, with garbage in front, or late."""
        data, late_s = reply.data, 0.0
        if fault := panel.takes(PAN_TILT, "misnamed", time_s, reply.sender):
            data = renamed(data, int(fault.number("as_id")))
        if data and (fault := panel.takes(PAN_TILT, "corrupt", time_s, reply.sender)):
            place = _below(panel, fault, len(data))
            changed = data[place] ^ (1 + _below(panel, fault, 255))
            data = data[:place] + bytes([changed]) + data[place + 1 :]
        if panel.takes(PAN_TILT, "half", time_s, reply.sender):
            data = data[: max(1, len(data) // 2)]
        if fault := panel.takes(PAN_TILT, "noise", time_s, reply.sender):
            size = 1 + _below(panel, fault, MOST_NOISE)
            data = bytes(_below(panel, fault, 256) for _ in range(size)) + data
        if fault := panel.find(PAN_TILT, "delayed", time_s):
            late_s += fault.number("delay_s")
        if fault := panel.takes(PAN_TILT, "late", time_s, reply.sender):
            late_s += fault.number("delay_s")
        return Sent(data, reply.delay_s, late_s)


def _below(panel: FaultPanel, fault: Fault, bound: int) -> int:
    """A whole number from 0 to under ``bound``."""
    return int(panel.draw(fault) * bound)
