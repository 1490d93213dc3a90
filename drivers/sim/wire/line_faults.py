"""Faults of a line: what becomes of a device's replies on their way to the host."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from drivers.faults import PAN_TILT, FaultPanel

if TYPE_CHECKING:
    from drivers.sim.wire.line import Reply


@dataclass(frozen=True)
class Sent:
    """A reply as it goes out.

    Attributes
    ----------
    data, delay_s
        As of ``Reply``.
    late_s
        By how much the host gets it late; the line is free meanwhile.
    """

    data: bytes
    delay_s: float
    late_s: float = 0.0


class LineFaults:
    """The faults of one line, asked of a panel; without a panel there are none."""

    def __init__(self, panel: FaultPanel | None) -> None:
        self._panel = panel

    def hung_up(self, time_s: float) -> bool:
        """Return whether the cable is pulled."""
        return False

    def apply(self, replies: Sequence[Reply], time_s: float) -> list[Sent]:
        """Return what goes out for the replies of one moment."""
        sent = [Sent(reply.data, reply.delay_s) for reply in replies]
        panel = self._panel
        if panel is None:
            return sent
        if panel.find(PAN_TILT, "off", time_s):
            return []
        sent = [one for one in sent if not panel.strikes(PAN_TILT, time_s)]
        if fault := panel.find(PAN_TILT, "delayed", time_s):
            sent = [Sent(one.data, one.delay_s, fault.number("delay_s")) for one in sent]
        return sent
