"""Turning the head at a rate: the heartbeats that keep it going, from a thread."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from mastctl import answers
from mastctl.client.connection import ClientError, DaemonHttp, escaped, given

BEAT_S = 0.12  # the daemon waits 0.5 s: three may get lost
ANSWER_S = 1.0
POLL_S = 0.02


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
            if self._error is not None:
                raise self._error
            self._rates = float(pan_rad_per_s), float(tilt_rad_per_s)
            self._changed.notify_all()

    def check(self) -> None:
        """Pass while heartbeats are taken; raises as `rates`."""
        with self._changed:
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
                    with self._changed:
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
            self._wait_ended(self._id)
            self._id, self._sequence = None, 0

    def _wait_ended(self, jog: str) -> None:
        """Wait for the jog's end, so that the next command is not refused for it."""
        until_s = time.monotonic() + ANSWER_S
        while time.monotonic() < until_s:
            path = f"/operations/{escaped(jog)}"
            if self._daemon.json(answers.OperationAnswer, "GET", path)["state"] not in ("queued", "running"):
                return
            time.sleep(POLL_S)
