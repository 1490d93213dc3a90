"""A pan/tilt head of two Feetech servos (`drivers.interfaces.PanTilt`).

One thread owns the bus (`drivers.servo_bus.head`). A servo has no watchdog: its goals are lent to it, so that
both axes stand soon after this process has died (``lease_s``). Nothing here moves the head but `move`.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from typing import Any

from drivers.clock import Clock
from drivers.feetech.link import Questions
from drivers.feetech.pair import FeetechPair, make_ready, open_pair
from drivers.feetech.settings import FeetechSettings, feetech_settings
from drivers.feetech.watch import FeetechWatch
from drivers.serial_line import OpenLine, SerialLine
from drivers.servo_bus.head import BusHead
from drivers.servo_bus.rest import halt_axes


def open_head(
    options: Mapping[str, Any], clock: Clock | None = None, open_line: OpenLine = SerialLine
) -> FeetechHead:
    """Open the head that the options of ``driver: feetech`` describe; see `settings.FeetechSettings`.

    Raises
    ------
    BadOptions
        For options that cannot be.
    LineLost, NoReply, BadReply, WrongDevice, HardwareFault
        If the servos cannot be reached or do not fit; the line is closed again.
    """
    return FeetechHead(feetech_settings(options), clock, open_line)


class FeetechHead(BusHead):
    """The head; parameters and errors as of `BusHead`."""

    settings: FeetechSettings

    def __init__(
        self, settings: FeetechSettings, clock: Clock | None = None, open_line: OpenLine = SerialLine
    ) -> None:
        self._questions = Questions()
        self._offsets: dict[int, int] = {}
        super().__init__(settings, clock, open_line)

    def _open(self) -> FeetechPair:
        return open_pair(
            self.settings, self._questions, self._offsets, self._bus.urgent, self._clock, self._open_line
        )

    def _watch(self, pair: FeetechPair) -> FeetechWatch:
        make_ready(pair, self.settings)
        return FeetechWatch(pair, self.settings.lease_s)


def halt(
    options: Mapping[str, Any], clock: Clock | None = None, open_line: OpenLine = SerialLine
) -> list[str]:
    """Command each axis that holds to stand, as `halt_axes`; its torque stays as it is.

    ``clock`` and ``open_line`` are those of `FeetechLink`. Raises BadOptions, LineLost, NoReply.
    """
    with closing(open_pair(feetech_settings(options), clock=clock, open_line=open_line)) as pair:
        return halt_axes(pair)
