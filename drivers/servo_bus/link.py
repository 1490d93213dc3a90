"""An open line to servos of one family, the base of its transactions."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager

from drivers.clock import Clock
from drivers.serial_line import OpenLine
from drivers.servo_bus.exchange import Exchange
from drivers.servo_bus.port import PacketFormat, Port

REPLY_TIMEOUT_S = 0.05  # USB adapters hold bytes back for up to 16 ms, the servo for up to 0.5 ms


class BusLink:
    """One open line; for one thread at a time.

    Raises LineLost, BadOptions.

    Parameters
    ----------
    port, baud, reply_timeout_s, urgent, clock, open_line
        As of `Port`; `Overtaken` may come from every method but `shout`.

    Attributes
    ----------
    exchange
        Asks one servo; its answers are proven by nothing.
    """

    def __init__(
        self,
        port: str,
        baud: int,
        reply_timeout_s: float,
        packets: PacketFormat,
        urgent: Callable[[], bool],
        clock: Clock | None,
        open_line: OpenLine,
    ) -> None:
        self.name = port
        self._port = Port(port, baud, reply_timeout_s, packets.take, urgent, clock=clock, open_line=open_line)
        self.clock = self._port.clock
        self._to_nobody = packets.to_nobody
        self.exchange = Exchange(self._port, packets)

    @property
    def baud(self) -> int:
        """Bits per second."""
        return self._port.baud

    def set_baud(self, baud: int) -> None:
        """Open the line anew at another speed. Raises LineLost, BadOptions."""
        self._port.set_baud(baud)

    def find_echo(self) -> bool:
        """Return whether the adapter gives back what is sent; if so, that is dropped from now on.

        Raises LineLost, BadReply if the line is gone, or never quiet.
        """
        self._port.echoes = self._port.comes_back(self._to_nobody)
        return self._port.echoes

    def close(self) -> None:
        """Let go of the line; never raises."""
        self._port.close()

    def undisturbed(self) -> AbstractContextManager[None]:
        """Within it nothing urgent breaks off what is said; for what must not be left half done."""
        return self._port.undisturbed()

    def quiet(self, quiet_s: float) -> None:
        """Drop what comes until nothing has come for ``quiet_s``. Raises LineLost, BadReply."""
        self.exchange.quiet(quiet_s)
