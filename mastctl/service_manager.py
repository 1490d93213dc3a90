"""What starts and watches this process, as systemd does: told when it is ready, how it is, and that it lives.

The protocol (sd_notify(3)) is a line of text in a datagram to the socket that ``NOTIFY_SOCKET`` names. Where
nobody asked, nothing is sent. Nothing here waits: a manager that reads nothing loses messages, no more.

The watchdog is fed by what must not stand still, one after the other: a turn of the head's thread asks for
it, and the event loop sends it. If either hangs nothing is sent, and the manager ends the process and runs
what its unit names for that, which stops the head.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Callable, Mapping

BEATS = 4  # messages in the time that the manager allows; it asks for two


class ServiceManager:
    """The manager of this process, or nobody.

    Parameters
    ----------
    environ
        ``NOTIFY_SOCKET``, ``WATCHDOG_USEC`` and ``WATCHDOG_PID`` are read from it.

    Attributes
    ----------
    watchdog_s
        Seconds without a sign of life after which the manager acts; None if it does not watch.
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
        """Say that requests are answered."""
        self._send("READY=1")

    def reloading(self) -> None:
        """Say that the configuration is read again; `ready` ends it."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self) -> None:
        """Say that the process ends on purpose."""
        self._send("STOPPING=1")

    def alive(self) -> None:
        """Feed the watchdog."""
        self._send("WATCHDOG=1")

    def status(self, sentence: str) -> None:
        """Say how things are, in one line, as ``systemctl status`` shows it."""
        self._send(f"STATUS={' '.join(sentence.split())}")

    def close(self) -> None:
        """Let go of the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, text: str) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):  # a manager that is gone, or reads nothing, holds nobody
                self._socket.sendto(text.encode(), self._address)


class Heartbeat:
    """Signs of life for a manager that watches; `turn` may come from any thread, as often as it likes.

    Parameters
    ----------
    manager
        Who is told; if it does not watch, nothing happens.
    in_loop
        Has a function called by the event loop, soon; may be called from any thread.
    now_s
        The machine's monotonic time, seconds.
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
        self._asked = False  # the loop has not come to the last one yet: another would only pile up

    def turn(self) -> None:
        """Take note that the calling thread goes on; waits for nothing."""
        if self._manager.watchdog_s is None or self._asked or self._now_s() < self._next_s:
            return
        self._next_s = self._now_s() + self._manager.watchdog_s / BEATS
        self._asked = True
        try:
            self._in_loop(self._beat)
        except RuntimeError:  # the loop has ended: so does the process
            self._asked = False

    def _beat(self) -> None:
        self._asked = False
        self._manager.alive()


def _watchdog_s(environ: Mapping[str, str]) -> float | None:
    """The time that a manager allows this very process between two signs of life."""
    text, process = environ.get("WATCHDOG_USEC", ""), environ.get("WATCHDOG_PID", "")
    if not text.isdecimal() or int(text) == 0 or (process and process != str(os.getpid())):
        return None
    return int(text) / 1e6
