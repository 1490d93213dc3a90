"""A lease that a client holds: renewed in time by a thread, under asyncio too, released at the end."""

from __future__ import annotations

import contextlib
import threading
import time
from typing import TYPE_CHECKING

from mastctl.client.connection import Broken, ClientError, Connection

if TYPE_CHECKING:
    from mastctl.client.answers import LeaseGranted

RENEWALS = 3  # within a lease's time, so that one may be lost
LEAST_TIMEOUT_S = 0.5


class HeldLease:
    """The right to steer, as long as nobody takes over; `Client.lease` makes one.

    Attributes
    ----------
    id, holder
        As the daemon told them.
    lost
        Why the lease is no longer held, None while it is; the next command is refused with the same reason.
    """

    def __init__(self, daemon: Connection, granted: LeaseGranted, for_s: float) -> None:
        self.id = str(granted["lease_id"])
        self.holder = str(granted["holder"])
        self.lost: ClientError | None = None
        self._for_s = for_s
        self._until_s = time.monotonic() + for_s
        # A connection of its own: the client's may be busy with a long wait.
        timeout_s = max(LEAST_TIMEOUT_S, for_s / RENEWALS)
        self._daemon = daemon.beside(min(daemon.timeout_s, timeout_s))
        self._daemon.lease_id = self.id
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._renew, name="lease", daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Renew no more and let others steer; never raises, since what was done was done."""
        self._ended.set()
        self._thread.join()
        if self.lost is None:
            with contextlib.suppress(ClientError):
                self._daemon.json("DELETE", "/lease")
        self._daemon.close()

    def _renew(self) -> None:
        """Renew until the end; a daemon that does not answer is asked again until the lease is over."""
        while not self._ended.wait(self._for_s / RENEWALS):
            asked_s = time.monotonic()
            try:
                self._daemon.json("POST", "/lease/renew", json={"for_s": self._for_s})
                self._until_s = asked_s + self._for_s
            except ClientError as error:
                passing = isinstance(error, Broken) or error.code in ("no_daemon", "timeout")
                if passing and time.monotonic() < self._until_s:
                    continue
                self.lost = error
                return
