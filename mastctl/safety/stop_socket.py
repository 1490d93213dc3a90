"""A Unix socket that takes stops and nothing else, beside the web side and independent of it.

A client sends one line, ``stop`` or ``estop NAME: REASON``, and gets one line: the answer, or why it failed.
Each connection has a thread of its own, so a silent one delays no other and no event loop is needed. Some
descriptors are kept for it, so that it answers when the process has none left.

`request` sends such a line from another process; it needs no configuration that can be read.
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
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from mastctl.errors import MastctlError, error_body
from mastctl.safety.state_folder import DAEMON_FILE, DAEMON_SCHEMA, folders_of

log = logging.getLogger(__name__)

FILE = "stop.sock"
LONGEST_PATH = 100  # bytes; the kernel's own bound is 108
LONGEST_LINE = 1024
SPARES = 8
SILENT_S = 5.0
POLL_S = 0.1  # how late the end is noticed
ANSWER_S = 5.0
VIA = "stop socket"

Verb = Literal["stop", "estop"]
CarryOut = Callable[[Verb, str | None, str | None], Mapping[str, Any]]
"""Carries a stop out, with an emergency stop's reason and name; returns the answer."""


class StopSocket(socketserver.ThreadingUnixStreamServer):
    """Listens at a path from its construction on, until `close`. Raises MastctlError if it cannot.

    A socket that a dead daemon has left at the path is replaced. Only this user may connect.
    """

    daemon_threads = True
    block_on_close = False
    request_queue_size = 4096

    def __init__(self, path: Path, carry_out: CarryOut) -> None:
        self.path = path
        self.carry_out = carry_out
        self._spares: list[int] = []
        if len(os.fsencode(path)) > LONGEST_PATH:
            message = f"{path} is longer than the {LONGEST_PATH} bytes that a socket's path may have"
            raise MastctlError(message)
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
        threading.Thread(target=self.serve_forever, args=(POLL_S,), name="stop socket", daemon=True).start()

    def close(self) -> None:
        """Take no more; what is under way is answered."""
        with contextlib.suppress(OSError):
            self.path.unlink(missing_ok=True)
        self.shutdown()
        self.server_close()
        while self._spares:
            os.close(self._spares.pop())

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
        carry_out: CarryOut = self.server.carry_out  # type: ignore[attr-defined]
        text = line.decode("utf-8", "replace").strip()
        verb, _, rest = text.partition(" ")
        name, colon, reason = rest.partition(":")
        name, reason = (name, reason) if colon else ("", rest)
        try:
            if verb == "estop":
                answer = carry_out("estop", reason.strip() or None, name.strip() or None)
            elif text == "stop":
                answer = carry_out("stop", None, None)
            else:
                return f"failed: '{text[:60]}' where 'stop' or 'estop NAME: REASON' is expected"
        except Exception as error:
            return f"failed: {error_body(error)['message']}"
        return f"{verb} {json.dumps(answer, ensure_ascii=True)}"


# From another process


class NoAnswer(Exception):
    """No program listens there, or none that answers as a daemon does."""


def sockets_of(folder: Path | None, config: Path | None, url: str | None) -> list[Path]:
    """Return the stop sockets of a daemon, whether a program listens there or not.

    ``folder`` is its state folder, ``config`` its configuration, which may be broken, ``url`` its address;
    None where that is not known.
    """
    if folder is not None:
        return [path for path, _ in _of(folder)]
    found = dict[Path, None]()  # a daemon is noted in its head's folder too
    for place in folders_of(config):
        for path, noted in _of(place):
            wrong = noted and (
                (config is not None and noted.get("config") != str(config.resolve()))
                or (url is not None and noted.get("url") != url)
            )
            if not wrong and (noted or url is None):
                found[path] = None
    return list(found)


def request(path: Path, line: str) -> dict[str, Any]:
    """Send one line; return the daemon's answer.

    Raises NoAnswer if no program listens, or none that answers as a daemon does; ValueError: with the
    daemon's own sentence, if it could not.
    """
    verb, _, rest = _answer(path, line).partition(" ")
    if verb == "failed:":
        raise ValueError(rest)
    try:
        answer = json.loads(rest)
    except (ValueError, RecursionError):
        answer = None
    if not isinstance(answer, dict) or verb != line.split()[0]:
        raise NoAnswer(f"the program that listens at {path} does not answer as a daemon does")
    return answer


def _answer(path: Path, line: str) -> str:
    """One line of answer; empty if the other side has closed without one."""
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as peer:
            peer.settimeout(ANSWER_S)
            peer.connect(str(path))
            peer.sendall(f"{line}\n".encode())
            with peer.makefile("rb") as answer:
                return answer.readline().decode("utf-8", "replace").strip()
    except TimeoutError:
        raise NoAnswer(
            f"{path} took the line but did not answer within {ANSWER_S:g} s; the head may still move"
        ) from None
    except (ConnectionResetError, BrokenPipeError):
        return ""
    except OSError as error:
        raise NoAnswer(f"no daemon listens at {path}: {error.strerror or error}") from None


def _of(folder: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    """The socket of a state folder, if there is one, and the note of its daemon."""
    noted: dict[str, Any] = {}
    with contextlib.suppress(OSError, ValueError, RecursionError):
        found = json.loads((folder / DAEMON_FILE).read_bytes())
        noted = found if isinstance(found, dict) and found.get("schema") == DAEMON_SCHEMA else {}
    path = Path(str(noted.get("stop_socket") or folder / FILE))
    with contextlib.suppress(OSError):
        if path.is_socket():
            yield path, noted
