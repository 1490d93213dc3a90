"""The program that starts and watches this process, as systemd does: it gets readiness, state, life signs.

The protocol (sd_notify(3)) is a line of text in a datagram to the socket that ``NOTIFY_SOCKET`` names;
without that nothing is sent. No call waits: a manager that reads nothing loses messages, no more.

The watchdog is fed by two threads one after the other: a turn of the head's thread requests it, and the event
loop sends it. If either hangs nothing is sent, and the manager ends the process and runs the command that its
unit names for that, which stops the head.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Callable, Mapping

BEATS = 4  # messages in the time that the manager allows; it asks for two


class ServiceManager:
    """The manager of this process, or none, by ``NOTIFY_SOCKET``, ``WATCHDOG_USEC`` and ``WATCHDOG_PID``.

    ``watchdog_s``: seconds without a sign of life after which it acts; None if it does not watch.
    """

    def __init__(self, environ: Mapping[str, str] = os.environ) -> None:
        address = environ.get("NOTIFY_SOCKET", "")
        self._socket: socket.socket | None = None
        self.watchdog_s = _watchdog_s(environ)
        if not address.startswith(("/", "@")):
            return
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)

    def ready(self) -> None:
        """State that requests are answered."""
        self._send("READY=1")

    def stopping(self) -> None:
        """State that the process ends on purpose."""
        self._send("STOPPING=1")

    def alive(self) -> None:
        """Feed the watchdog."""
        self._send("WATCHDOG=1")

    def status(self, sentence: str) -> None:
        """State how the daemon is, in one line, as ``systemctl status`` shows it."""
        self._send(f"STATUS={' '.join(sentence.split())}")

    def close(self) -> None:
        """Let go of the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, text: str) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):  # a manager that is gone, or reads nothing
                self._socket.sendto(text.encode(), self._address)


class Heartbeat:
    """Signs of life for a manager that watches; `turn` may be called from any thread, at any rate.

    ``in_loop`` has a function called by the event loop, soon, from any thread.
    """

    def __init__(
        self,
        manager: ServiceManager,
        in_loop: Callable[[Callable[[], None]], object],
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._manager = manager
        self._in_loop = in_loop
        self._now_s = now_s
        self._next_s = float("-inf")
        self._requested = False  # the loop has not sent the last one yet

    def turn(self) -> None:
        """Take note that the calling thread goes on; waits for nothing."""
        if self._manager.watchdog_s is None or self._requested or self._now_s() < self._next_s:
            return
        self._next_s = self._now_s() + self._manager.watchdog_s / BEATS
        self._requested = True
        try:
            self._in_loop(self._beat)
        except RuntimeError:  # the loop has ended: so does the process
            self._requested = False

    def _beat(self) -> None:
        self._requested = False
        self._manager.alive()


def _watchdog_s(environ: Mapping[str, str]) -> float | None:
    """The time that a manager allows this very process between two signs of life."""
    text, process = environ.get("WATCHDOG_USEC", ""), environ.get("WATCHDOG_PID", "")
    if not text.isdecimal() or int(text) == 0 or (process and process != str(os.getpid())):
        return None
    return int(text) / 1e6
