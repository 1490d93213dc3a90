"""Steering from a thread: a lease that is renewed, and the heartbeats of a head that turns at a rate."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from mastctl import answers
from mastctl.client.connection import ClientError, DaemonHttp, escaped, given, plain_name, polled

RENEWALS = 3  # within a lease's time, so that one may be lost
LEAST_TIMEOUT_S = 0.5
BEAT_S = 0.12  # the daemon waits 0.5 s: three may get lost
ANSWER_S = 1.0


class LeaseCalls:
    """Acquiring and using a lease."""

    daemon: DaemonHttp

    @contextmanager
    def lease(
        self,
        name: str | None = None,
        for_s: float = 30.0,
        take_over: str | None = None,
        ends_with_stop: bool = False,
    ) -> Iterator[None]:
        """Steer alone inside the block: a thread renews the lease, and this client's commands carry it.

        A motion that still runs when the lease ends, by the block's end too, is stopped: wait for it. Raises
        ClientError ``leased`` if another client steers; once another has taken over, each command is refused
        with the reason.

        ``name`` is the holder's, by default this client's; the lease outlives a holder that falls silent by
        ``for_s``, 1 to 3600 s. ``take_over``: the reason for taking it from the client that steers.
        ``ends_with_stop``: it ends with the next stop of the head, for a program that would go on with its
        next move otherwise.
        """
        granted = self.acquire_lease(name, for_s, take_over, ends_with_stop)
        before, self.daemon.lease_id = self.daemon.lease_id, granted["lease_id"]
        # A connection of its own: the client's may be busy with a long wait.
        beside = self.daemon.beside(min(self.daemon.timeout_s, max(LEAST_TIMEOUT_S, for_s / RENEWALS)))
        ended = threading.Event()
        thread = threading.Thread(target=_renewed, args=(beside, ended, for_s), name="lease", daemon=True)
        thread.start()
        try:
            yield
        finally:
            self.daemon.lease_id = before
            ended.set()
            thread.join()
            with contextlib.suppress(ClientError):  # what was done was done
                beside.json(answers.LeaseAnswer, "DELETE", "/lease")
            beside.close()

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

    def release_lease(self) -> None:
        """Release the lease in use."""
        self.daemon.command(answers.LeaseAnswer, "DELETE", "/lease")


def _renewed(daemon: DaemonHttp, ended: threading.Event, for_s: float) -> None:
    """Renew a lease until the end; without an answer, again until the lease is over."""
    until_s = time.monotonic() + for_s
    while not ended.wait(for_s / RENEWALS):
        sent_s = time.monotonic()
        try:
            daemon.json(answers.LeaseGranted, "POST", "/lease/renew", json={"for_s": for_s})
            until_s = sent_s + for_s
        except ClientError as error:
            if error.code not in ("no_daemon", "timeout") or time.monotonic() >= until_s:
                return


class Jog:
    """The head under the control of this program; made by `mastctl.client.Client.jog`. A context manager.

    While the block runs, heartbeats go out by themselves with the rates that were set last. At its end, and
    half a second after this process hangs or dies, the head stops.
    """

    def __init__(self, connect: Callable[[], DaemonHttp]) -> None:
        self._daemon = connect()
        self._changed = threading.Condition()
        self._rates = (0.0, 0.0)
        self._ending = False
        self._sequence = 0
        self._id: str | None = None
        self._error: ClientError | None = None
        self._held: dict[str, str] = {}
        self._thread = threading.Thread(target=self._work, name="jog heartbeats", daemon=True)

    @property
    def held(self) -> dict[str, str]:
        """The axes that a limit or a keep-out stops, and why."""
        return dict(self._held)

    def rates(self, pan_rad_per_s: float, tilt_rad_per_s: float) -> None:
        """Turn at these rates from now on; both zero stops the head.

        Raises ClientError if the daemon has refused a heartbeat since: ``jog_ended`` where it had missed them
        for too long, ``busy``, ``no_daemon``. The head stops then by itself.
        """
        with self._changed:
            self.check()
            self._rates = float(pan_rad_per_s), float(tilt_rad_per_s)
            self._changed.notify_all()

    def check(self) -> None:
        """Pass while heartbeats are taken; raises as `rates`."""
        if self._error is not None:
            raise self._error

    def __enter__(self) -> Jog:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *ignored: object) -> None:
        with self._changed:
            self._rates, self._ending = (0.0, 0.0), True
            self._changed.notify_all()
        self._thread.join(3 * ANSWER_S)
        self._daemon.close()
        if kind is None:
            self.check()

    def _work(self) -> None:
        while True:
            with self._changed:
                rates, ending = self._rates, self._ending
            try:
                self._send(rates)
            except ClientError as error:
                if error.code != "timeout":  # the next heartbeat shows whether the jog runs
                    self._error = error
                    return
            with self._changed:
                if ending:
                    return
                if rates == self._rates and not self._ending:
                    at_rest = rates == (0.0, 0.0) and self._id is None
                    self._changed.wait(None if at_rest else BEAT_S)

    def _send(self, rates: tuple[float, float]) -> None:
        if rates == (0.0, 0.0) and self._id is None:
            return
        self._sequence += 1
        body = given(pan_rad_per_s=rates[0], tilt_rad_per_s=rates[1], sequence=self._sequence, id=self._id)
        answer = self._daemon.json(answers.JogAnswer, "POST", "/jog", json=body)
        self._id, self._held = answer["id"], answer["held"]
        if rates == (0.0, 0.0) and self._id is not None:
            path = (
                f"/operations/{escaped(self._id)}"  # its end, so that the next command is not refused for it
            )
            for record in polled(lambda _: self._daemon.json(answers.OperationAnswer, "GET", path), ANSWER_S):
                if record["state"] not in ("queued", "running"):
                    break
            self._id, self._sequence = None, 0
