"""A Unix socket that takes stops and nothing else, beside the web side and independent of it.

A client sends one line, ``stop`` or ``estop NAME: REASON``, and gets one line: what was done, or why it
failed. Each connection has a thread of its own, so a silent one delays no other and no event loop is needed.
Some descriptors are kept for it, so that it answers when the process has none left.
"""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import os
import socket
import socketserver
import threading
import time
from pathlib import Path
from typing import Any, Protocol

from mastctl.answers import EstopTold, StopTold
from mastctl.errors import MastctlError, error_body

log = logging.getLogger(__name__)

FILE = "stop.sock"
LONGEST_PATH = 100  # bytes; the kernel's own bound is 108
LONGEST_LINE = 1024
SPARES = 8
SILENT_S = 5.0
POLL_S = 0.1  # how late the end is noticed


class StopHandlers(Protocol):
    """What the socket carries out."""

    def stop_answer(self) -> StopTold: ...
    def estop(self, reason: str | None, name: str | None) -> EstopTold: ...


class StopSocket:
    """Listens at a path from its construction on, until `close`. Raises MastctlError if it cannot.

    A socket that a dead daemon has left at the path is replaced. Only this user may connect.
    """

    def __init__(self, path: Path, stops: StopHandlers) -> None:
        self.path = path
        self._server = _Server(path, stops)
        threading.Thread(
            target=self._server.serve_forever, args=(POLL_S,), name="stop socket", daemon=True
        ).start()

    def close(self) -> None:
        """Take no more; what is under way is answered."""
        with contextlib.suppress(OSError):
            self.path.unlink(missing_ok=True)
        self._server.shutdown()
        self._server.server_close()


class _Server(socketserver.ThreadingUnixStreamServer):
    daemon_threads = True
    block_on_close = False
    request_queue_size = 4096

    def __init__(self, path: Path, stops: StopHandlers) -> None:
        self.stops = stops
        self._spares: list[int] = []
        if len(os.fsencode(path)) > LONGEST_PATH:
            raise MastctlError(
                f"{path} is longer than the {LONGEST_PATH} bytes that a socket's path may have"
            )
        super().__init__(str(path), _Connection, bind_and_activate=False)
        try:
            path.unlink(missing_ok=True)  # the folder is this daemon's alone
            os.fchmod(self.fileno(), 0o600)  # bind takes it over; a umask would be every thread's
            self.server_bind()
            self.server_activate()
        except OSError as error:
            self.server_close()
            raise MastctlError(f"{path}: cannot listen for stops there: {error.strerror or error}") from None
        self._keep_spares()

    def get_request(self) -> tuple[socket.socket, Any]:
        """Accept a connection, with a descriptor of those that are kept if there is no other."""
        while True:
            try:
                return super().get_request()
            except OSError as error:
                if error.errno not in (errno.EMFILE, errno.ENFILE):
                    raise
                if not self._spares:
                    time.sleep(0.001)  # stops are under way; their descriptors come back soon
                    raise
                os.close(self._spares.pop())

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection in a thread of its own, or in this one if the system has none."""
        try:
            super().process_request(request, client_address)
        except RuntimeError:
            self.process_request_thread(request, client_address)

    def close_request(self, request: Any) -> None:
        """Close a connection, and keep its descriptor where too few are kept."""
        super().close_request(request)
        self._keep_spares()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log a defect, and go on."""
        log.exception("the stop socket met a defect of the program")

    def server_close(self) -> None:
        """Close the socket and give the kept descriptors back."""
        super().server_close()
        while self._spares:
            os.close(self._spares.pop())

    def _keep_spares(self) -> None:
        with contextlib.suppress(OSError):
            while len(self._spares) < SPARES:
                self._spares.append(os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC))


class _Connection(socketserver.StreamRequestHandler):
    """One line taken, carried out, and answered by one line."""

    timeout = SILENT_S

    def handle(self) -> None:
        """Answer a line, or one that ends with its sender's side; leave a client that sends none."""
        with contextlib.suppress(OSError):
            line = self.rfile.readline(LONGEST_LINE + 1)
            if line and len(line) <= LONGEST_LINE:
                self.wfile.write(" ".join(self._carry_out(line).split()).encode() + b"\n")

    def _carry_out(self, line: bytes) -> str:
        stops: StopHandlers = self.server.stops  # type: ignore[attr-defined]
        text = line.decode("utf-8", "replace").strip()
        verb, _, rest = text.partition(" ")
        try:
            answer: StopTold | EstopTold
            if verb == "stop" and not rest:
                answer = stops.stop_answer()
            elif verb == "estop":
                name, colon, reason = rest.partition(":")
                name, reason = (name, reason) if colon else ("", rest)
                answer = stops.estop(reason.strip() or None, name.strip() or None)
            else:
                return f"failed: '{text[:60]}' where 'stop' or 'estop NAME: REASON' is expected"
        except Exception as error:
            return f"failed: {error_body(error)['message']}"
        return f"{verb} {json.dumps(answer, ensure_ascii=True)}"
