"""What the stop socket carries out, and what is recorded of it after."""

from __future__ import annotations

from mastctl.answers import EstopTold, StopTold
from mastctl.commands.caller import Caller
from mastctl.commands.entry import ESTOP, STOP, Asked, Entry
from mastctl.safety.stop_socket import Stops

VIA = "stop socket"


class SocketStops:
    """Stops from whoever connects to a daemon's socket.

    Parameters
    ----------
    stops
        Carries them out.
    entry
        Records them.
    """

    def __init__(self, stops: Stops, entry: Entry) -> None:
        self._stops = stops
        self._entry = entry

    def stop_told(self) -> StopTold:
        """Stop the mast; return what is to be told."""
        return self._entry.first(STOP, Asked(Caller(role="view", via=VIA)), self._stops.stop_told)

    def estop(self, reason: str | None, name: str | None) -> EstopTold:
        """Stop it and latch; return what is to be told."""
        asked = Asked(Caller(role="view", via=VIA), request={"reason": reason, "name": name})
        return self._entry.first(ESTOP, asked, lambda: self._stops.estop(reason, name))

    def latch_estop(self, reason: str | None, name: str | None) -> object:
        """Let no move out from now on, at once."""
        return self._stops.latch_estop(reason, name)
