"""A stop sent to a daemon's socket, from another process; needs no configuration that can be read."""

from __future__ import annotations

import contextlib
import json
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from calib.errors import BadFile
from mastctl.safety.state_file import StateFile
from mastctl.safety.state_folder import DAEMON_FILE, DAEMON_SCHEMA, folders_of
from mastctl.safety.stop_socket import FILE

ANSWER_S = 5.0


class NoAnswer(Exception):
    """No program listens there, or none that answers as a daemon does."""


def sockets_of(folder: Path | None, config: Path | None, url: str | None) -> list[Path]:
    """Return the stop sockets of a daemon, whether a program listens there or not.

    ``folder`` is its state folder, ``config`` its configuration, which may be broken, ``url`` its address;
    None where that is not known.
    """
    if folder is not None:
        return [path for path, _ in _of(folder)]
    found = []
    for place in folders_of(config):
        for path, noted in _of(place):
            wrong = noted and (
                (config is not None and noted.get("config") != str(config.resolve()))
                or (url is not None and noted.get("url") != url)
            )
            if not wrong and (noted or url is None):
                found.append(path)
    return found


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
    until_s = time.monotonic() + ANSWER_S
    answer = b""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as peer:
        peer.settimeout(ANSWER_S)
        try:
            _connect(peer, path, until_s)
            peer.sendall(f"{line}\n".encode())
            while not answer.endswith(b"\n"):
                peer.settimeout(max(0.01, until_s - time.monotonic()))
                part = peer.recv(4096)
                if not part:
                    break
                answer += part
        except TimeoutError:
            raise NoAnswer(
                f"{path} took the line but did not answer within {ANSWER_S:g} s; the head may still move"
            ) from None
        except (ConnectionResetError, BrokenPipeError):
            return ""
        except OSError as error:
            raise NoAnswer(f"no daemon listens at {path}: {error.strerror or error}") from None
    return answer.decode("utf-8", "replace").strip()


def _connect(peer: socket.socket, path: Path, until_s: float) -> None:
    """Connect, after other waiting clients. Raises OSError."""
    while True:
        try:
            peer.connect(str(path))
            return
        except BlockingIOError:  # the kernel's queue is full; it is emptied quickly
            if time.monotonic() > until_s:
                raise TimeoutError from None
            time.sleep(0.001)


def _of(folder: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    """The socket of a state folder, if there is one, and what is written down of its daemon."""
    noted: dict[str, Any] = {}
    with contextlib.suppress(BadFile):
        noted = StateFile(folder / DAEMON_FILE, DAEMON_SCHEMA).read() or {}
    path = Path(str(noted.get("stop_socket") or folder / FILE))
    with contextlib.suppress(OSError):
        if path.is_socket():
            yield path, noted
