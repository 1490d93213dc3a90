"""When an experiment runs: by the clock of the daemon that it is run on."""

from __future__ import annotations

import time

from mastctl.client import Client, ClientError


class RunTime:
    """The time of one run, which begins here.

    Durations are the daemon's, so that those of a simulated rover are what a rover would have taken. One
    whose time passes only on demand (``simulation.speed: max``) knows no calendar and no address: the record
    of such a run is to be the same every time.

    Attributes
    ----------
    started
        The date, or words that say that there is none.
    where
        The daemon's address, or words.
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        self._began_s = self.now_s()
        self.started = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        self.where = client.url
        if on_demand(client):
            self.started = f"{self._began_s:.3f} s of the simulated rover's own time"
            self.where = "a simulated rover"

    def now_s(self) -> float:
        """Return the daemon's time, seconds."""
        return float(self._client.status()["now_s"])

    def since_s(self, moment_s: float | None = None) -> float:
        """Return how long the run, or what began at ``moment_s``, takes by now, seconds."""
        return self.now_s() - (self._began_s if moment_s is None else moment_s)


def on_demand(client: Client) -> bool:
    """Whether the daemon is a simulated rover whose time passes only on demand."""
    try:
        return bool(client.simulation_time()["speed"] == "max")
    except ClientError:  # anything else than this program's own simulated rover
        return False
