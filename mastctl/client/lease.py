"""The lease that a client steers under: acquired, and renewed by a thread."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from mastctl import answers
from mastctl.client.connection import Broken, ClientError, DaemonHttp, given, plain_name

RENEWALS = 3  # within a lease's time, so that one may be lost
LEAST_TIMEOUT_S = 0.5


class HeldLease:
    """The right to steer, as long as no other client takes over; `LeaseCalls.lease` makes one.

    ``lost``: why the lease is over, None while it lasts; the next command is refused with the same reason.
    """

    def __init__(self, daemon: DaemonHttp, granted: answers.LeaseGranted, for_s: float) -> None:
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
                self._daemon.json(answers.LeaseAnswer, "DELETE", "/lease")
        self._daemon.close()

    def _renew(self) -> None:
        """Renew until the end; without an answer, again until the lease is over."""
        while not self._ended.wait(self._for_s / RENEWALS):
            sent_s = time.monotonic()
            try:
                renewal = {"for_s": self._for_s}
                self._daemon.json(answers.LeaseGranted, "POST", "/lease/renew", json=renewal)
                self._until_s = sent_s + self._for_s
            except ClientError as error:
                passing = isinstance(error, Broken) or error.code in ("no_daemon", "timeout")
                if passing and time.monotonic() < self._until_s:
                    continue
                self.lost = error
                return


class LeaseCalls:
    """Acquiring, renewing and releasing a lease."""

    daemon: DaemonHttp

    @contextmanager
    def lease(
        self,
        name: str | None = None,
        for_s: float = 30.0,
        take_over: str | None = None,
        ends_with_stop: bool = False,
    ) -> Iterator[HeldLease]:
        """Steer alone inside the block: a thread renews the lease, and this client's commands carry it.

        A motion that still runs when the lease ends, by the block's end too, is stopped: wait for it. Raises
        ClientError ``leased`` if another client steers.

        ``name`` is the holder's, by default this client's; the lease outlives a holder that falls silent by
        ``for_s``, 1 to 3600 s. ``take_over``: the reason for taking it from the client that steers.
        ``ends_with_stop``: it ends with the next stop of the head, for a program that would go on with its
        next move otherwise.
        """
        granted = self.acquire_lease(name, for_s, take_over, ends_with_stop)
        before, lease = self.daemon.lease_id, HeldLease(self.daemon, granted, for_s)
        self.daemon.lease_id = lease.id
        try:
            yield lease
        finally:
            self.daemon.lease_id = before
            lease.end()

    def control(self) -> answers.ControlAnswer | None:
        """Return the client that steers, or None."""
        return self.daemon.json(answers.LeaseAnswer, "GET", "/lease")["control"]

    def acquire_lease(
        self,
        name: str | None = None,
        for_s: float = 30.0,
        take_over: str | None = None,
        ends_with_stop: bool = False,
    ) -> answers.LeaseGranted:
        """Acquire or take over a lease that is not renewed; arguments as for `lease`.

        Returns ``lease_id``, ``holder``, ``for_s`` and ``until``; `use_lease` has commands carry it.
        """
        body = given(for_s=float(for_s), ends_with_stop=ends_with_stop or None, name=name, reason=take_over)
        path = "/lease" if take_over is None else "/lease/take"
        return self.daemon.command(answers.LeaseGranted, "POST", path, body)

    def use_lease(self, lease_id: str | None) -> None:
        """Have each command carry a lease from now on, or none."""
        self.daemon.lease_id = None if lease_id is None else plain_name(lease_id)

    def renew_lease(self, for_s: float | None = None) -> answers.LeaseGranted:
        """Have the lease in use run for ``for_s`` seconds from now on, by default as long as at first."""
        body = given(for_s=None if for_s is None else float(for_s))
        return self.daemon.command(answers.LeaseGranted, "POST", "/lease/renew", body)

    def release_lease(self) -> None:
        """Release the lease in use."""
        self.daemon.command(answers.LeaseAnswer, "DELETE", "/lease")
