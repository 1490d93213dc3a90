"""What the stop socket carries out, and what is recorded of it after."""

from __future__ import annotations

from typing import Any, Protocol

from mastctl.commands.caller import Caller
from mastctl.commands.entry import ESTOP, STOP, Asked, Entry
from mastctl.safety.stop_socket import Stops

VIA = "stop socket"


class Recorded(Stops, Protocol):
    """A service whose stops are recorded."""

    entry: Entry


class SocketStops:
    """The stops of a service, from whoever connects to its socket."""

    def __init__(self, service: Recorded) -> None:
        self._service = service

    def stop_told(self) -> dict[str, Any]:
        """Stop the mast; return what is to be told."""
        return self._service.entry.first(STOP, Asked(Caller(role="view", via=VIA)), self._service.stop_told)

    def estop(self, reason: str | None, name: str | None) -> dict[str, Any]:
        """Stop it and latch; return what is to be told."""
        asked = Asked(Caller(role="view", via=VIA), request={"reason": reason, "name": name})
        return self._service.entry.first(ESTOP, asked, lambda: self._service.estop(reason, name))

    def latch_estop(self, reason: str | None, name: str | None) -> object:
        """Let no move out from now on, at once."""
        return self._service.latch_estop(reason, name)
