"""A Unix socket that takes stops and nothing else, beside the web side and independent of it.

Whoever connects sends one line, ``stop`` or ``estop NAME: REASON``, and gets one line: what happened, or why
not. Its threads are its own, no event loop is asked, no request of anybody else comes first. Peers that say
nothing never fill it: the newest comes in, and the one that has been silent longest goes. Some descriptors
are kept for it, so that it answers when the process has none left.
"""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import os
import select
import socket
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Protocol

from mastctl.answers import EstopTold, StopTold
from mastctl.errors import MastctlError, error_body
from mastctl.safety.stop_threads import StopsHang, StopThreads

log = logging.getLogger(__name__)

FILE = "stop.sock"
LONGEST_PATH = 100  # bytes; the kernel's own bound is 108
LONGEST_LINE = 1024
SILENT_PEERS = 32
ASKING_PEERS = 128
AT_ONCE = 64
SPARES = 8
SILENT_S = 5.0
ANSWER_S = 3.0  # as over HTTP: beyond this it is told that nothing is known
WAITING_IN_KERNEL = 4096
THREADS = 2


class StopHandlers(Protocol):
    """What the socket carries out."""

    def stop_told(self) -> StopTold:
        """Stop the mast; return what is to be told."""

    def estop(self, reason: str | None, name: str | None) -> EstopTold:
        """Stop it and latch; return what is to be told."""

    def latch_estop(self, reason: str | None, name: str | None) -> object:
        """Let no move out from now on, at once."""


class StopSocket:
    """Listens at a path from its construction on, until `close`.

    Parameters
    ----------
    path
        Where; a socket that a dead daemon has left there is replaced. Only this user may connect.
    stops
        What carries them out.

    Raises
    ------
    MastctlError
        If it cannot listen there.
    """

    def __init__(self, path: Path, stops: StopHandlers) -> None:
        self.path = path
        self._stops = stops
        self._listener = _listener(path)
        self._spares = [os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC) for _ in range(SPARES)]
        self._starved = False  # of descriptors
        self._peers: dict[int, _Peer] = {}
        self._poll = select.poll()
        self._poll.register(self._listener, select.POLLIN)
        self._threads = StopThreads(THREADS)
        self._ended = threading.Event()
        threading.Thread(target=self._work, name="stop socket", daemon=True).start()

    def close(self) -> None:
        """Take no more; what is under way is answered. Does not wait."""
        self._ended.set()
        with contextlib.suppress(OSError):
            self.path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)  # wakes the thread, which closes it
        self._threads.close()

    # In its own thread

    def _work(self) -> None:
        while not self._ended.is_set():
            try:
                self._turn()
            except Exception:  # it must go on: there is no other door like it
                log.exception("the stop socket met a defect of the program")
                time.sleep(0.01)
        for number in list(self._peers):
            if self._peers[number].asked_s is None:
                self._leave(number)
        self._listener.close()
        while self._spares:
            os.close(self._spares.pop())

    def _turn(self) -> None:
        """Wait for something to happen, half a second at most, and deal with it."""
        ready = [number for number, _ in self._poll.poll(500)]
        for number in ready:
            if number in self._peers:
                self._hear(number)
        if self._listener.fileno() in ready:  # last: a number that has become free may come again
            for _ in range(AT_ONCE):
                if not self._took():
                    break
        now_s = time.monotonic()
        for number, peer in list(self._peers.items()):
            if peer.asked_s is None and now_s - peer.since_s > SILENT_S:
                self._leave(number)
            elif peer.asked_s is not None and now_s - peer.asked_s > ANSWER_S:
                peer.answer(
                    f"failed: the stop did not come back within {ANSWER_S:g} s; the head may still move"
                )
                self._leave(number)
        while len(self._spares) < SPARES:
            try:
                self._spares.append(os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC))
            except OSError:
                break

    def _took(self) -> bool:
        """Let one peer in, and hear what it has said already; return whether there was one."""
        silent = [number for number, peer in self._peers.items() if peer.asked_s is None]
        if len(silent) >= SILENT_PEERS:
            self._leave(silent.pop(0))
        crowded = len(self._peers) - len(silent) >= ASKING_PEERS
        taken = None if crowded else self._accepted()
        if taken is None and silent and self._starved:
            self._leave(silent.pop(0))
            taken = self._accepted()
        if taken is None:
            if crowded or self._starved:
                time.sleep(0.001)  # stops are under way, or every descriptor is in use; some come back soon
            return False
        taken.setblocking(False)
        number = taken.fileno()
        self._peers[number] = _Peer(taken, time.monotonic())
        self._poll.register(number, select.POLLIN)
        self._hear(number)
        return True

    def _accepted(self) -> socket.socket | None:
        """The next peer, with a descriptor of those that are kept if there is no other."""
        self._starved = False
        while True:
            try:
                return self._listener.accept()[0]
            except BlockingIOError:
                return None
            except OSError as error:
                if error.errno not in (errno.EMFILE, errno.ENFILE) or not self._somebody_waits():
                    return None  # the kernel looks for a descriptor first, and then for somebody
                self._starved = True
                if not self._spares:
                    return None
                os.close(self._spares.pop())

    def _somebody_waits(self) -> bool:
        """Whether somebody wants to be let in; needs no descriptor."""
        waiting = select.poll()
        waiting.register(self._listener, select.POLLIN)
        return bool(waiting.poll(0))

    def _hear(self, number: int) -> None:
        """Take what a peer says; a whole line is carried out."""
        peer = self._peers[number]
        if peer.asked_s is not None:  # answered, or gone meanwhile
            self._leave(number)
            return
        line = peer.line()
        if line is None:
            self._leave(number)
        elif line:
            self._poll.modify(number, 0)  # from now on it is only heard that it goes
            self._carry_out(peer, line)

    def _carry_out(self, peer: _Peer, line: bytes) -> None:
        peer.asked_s = time.monotonic()
        words = line.decode("utf-8", "replace").strip()
        verb, _, rest = words.partition(" ")
        work: Callable[[], StopTold | EstopTold]
        if verb == "stop" and not rest:
            work = self._stops.stop_told
        elif verb == "estop":
            name, colon, reason = rest.partition(":")
            told = (reason.strip() or None, name.strip() or None) if colon else (rest.strip() or None, None)
            self._stops.latch_estop(*told)  # whatever becomes of the stop
            work = partial(self._stops.estop, *told)
        else:
            peer.answer(f"failed: '{words[:60]}' where 'stop' or 'estop NAME: REASON' is expected")
            return
        try:
            self._threads.submit(work).add_done_callback(lambda future: peer.answer(_told(verb, future)))
        except StopsHang as error:
            peer.answer(f"failed: {error}")

    def _leave(self, number: int) -> None:
        peer = self._peers.pop(number)
        self._poll.unregister(number)
        peer.close()


class _Peer:
    """One who has connected."""

    def __init__(self, taken: socket.socket, since_s: float) -> None:
        self.since_s = since_s
        self.asked_s: float | None = None
        self._socket = taken
        self._heard = b""
        self._lock = threading.Lock()  # an answer comes from another thread than the closing
        self._answered = False

    def line(self) -> bytes | None:
        """Return its line if it has come whole, empty bytes if not yet, None if it says nothing of use."""
        try:
            data = self._socket.recv(LONGEST_LINE + 1)
        except BlockingIOError:
            return b""
        except OSError:
            return None
        self._heard += data
        line, end, _ = self._heard.partition(b"\n")
        if end or (not data and line):  # who closes its side has said all
            return line or b" "
        if not data or len(self._heard) > LONGEST_LINE:
            return None
        return b""

    def answer(self, line: str) -> None:
        """Send one line, at once or not at all, and nothing after it."""
        with self._lock, contextlib.suppress(OSError):
            if not self._answered:
                self._answered = True
                self._socket.send(" ".join(line.split()).encode() + b"\n")
                self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        with self._lock:
            self._socket.close()


def _told(verb: str, future: Future[StopTold | EstopTold]) -> str:
    """The answer's line: the verb and what was done as JSON, or ``failed`` and a sentence."""
    error = future.exception()
    if error is not None:
        return f"failed: {error_body(error)['message']}"
    return f"{verb} {json.dumps(future.result(), ensure_ascii=True)}"


def _listener(path: Path) -> socket.socket:
    if len(os.fsencode(path)) > LONGEST_PATH:
        raise MastctlError(f"{path} is longer than the {LONGEST_PATH} bytes that a socket's path may have")
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        path.unlink(missing_ok=True)  # the folder is this daemon's alone
        os.fchmod(listener.fileno(), 0o600)  # bind takes it over; a umask would be every thread's
        listener.bind(str(path))
        listener.listen(WAITING_IN_KERNEL)
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        raise MastctlError(f"{path}: cannot listen for stops there: {error.strerror or error}") from None
    return listener
