"""What the daemon holds of the process that speaks to viewers (`mastctl.live.server`)."""

from __future__ import annotations

import contextlib
import json
import logging
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection
from typing import Any

from google.protobuf.message import Message as ProtobufMessage

from mastctl.errors import Unable
from mastctl.live.wire import Close, Listening, Message, Open, Watched
from mastctl.recorder.schemas import described
from mastctl.recorder.writer import Clocks

log = logging.getLogger(__name__)

SERVER = "mastctl.live.server"
START_S = 20.0
END_S = 2.0


class Screen:
    """A server for viewers, to which messages are written as into a file. A context manager.

    Parameters
    ----------
    host, port
        Where it listens; port 0 is any free one.
    clocks
        Stamps the messages.
    on_change
        Called when `watched` or `alive` changed, by a thread of its own; must return at once.

    Attributes
    ----------
    port
        Where it listens.
    watched
        The topics that somebody watches; what is written to others goes nowhere.
    alive
        False when the process has ended.

    Raises
    ------
    Unable
        ``address_in_use``, ``live_view`` if it cannot listen there.
    OSError
        If the process cannot be started; from writing, if it has ended.
    """

    def __init__(self, host: str, port: int, clocks: Clocks, on_change: Callable[[], None]) -> None:
        self.clocks = clocks
        self.watched: frozenset[str] = frozenset()
        self.alive = True
        self._on_change = on_change
        self._lock = threading.Lock()
        self._open: dict[str, str] = {}
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", SERVER, str(theirs.fileno()), host, str(port)],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # a terminal's Ctrl-C is the daemon's
            )
        self._pipe = Connection(ours.detach())
        try:
            self.port = self._started(host, port)
        except BaseException:
            self.close()
            raise
        threading.Thread(target=self._hear, name="live view's viewers", daemon=True).start()

    def _started(self, host: str, port: int) -> int:
        try:
            answer = self._pipe.recv() if self._pipe.poll(START_S) else Listening(refused="it does not start")
        except (EOFError, OSError):
            answer = Listening(refused="it ended while it started")
        assert isinstance(answer, Listening)
        if not answer.refused:
            return answer.port
        if "in use" in answer.refused:
            words = f"another program listens at {host}:{port}, so nothing is shown there"
            raise Unable("address_in_use", f"{words}; choose another foxglove.port or end that program")
        raise Unable("live_view", f"nothing is shown at {host}:{port}: {answer.refused}")

    def offer(self, topic: str, schema: str) -> None:
        """Let viewers ask for a topic; ``schema`` as `mastctl.recorder.schemas` names it."""
        with self._lock:
            if self._open.get(topic) == schema:
                return
            if topic in self._open:
                self._pipe.send(Close(topic))
            self._open[topic] = schema
            known = described(schema)
            self._pipe.send(Open(topic, known.message, schema, known.schema, known.data))

    def add_json(self, topic: str, kind: str, told: Mapping[str, Any], time_s: float, now_s: float) -> None:
        """Show one JSON message; ``kind`` names its schema."""
        if topic in self.watched:
            data = json.dumps(told, allow_nan=False, separators=(",", ":")).encode()
            self._show(topic, f"mastctl.{kind}", data, time_s)

    def add_message(self, topic: str, message: ProtobufMessage, time_s: float, now_s: float) -> None:
        """Show one of Foxglove's messages."""
        if topic in self.watched:
            self._show(topic, message.DESCRIPTOR.full_name, message.SerializeToString(), time_s)

    def close(self) -> None:
        """End the process; bounded."""
        self._process.kill()  # it holds nothing that could be lost
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(END_S)

    def __enter__(self) -> Screen:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _show(self, topic: str, schema: str, data: bytes, time_s: float) -> None:
        self.offer(topic, schema)
        with self._lock:
            self._pipe.send(Message(topic, data, self.clocks.ns(time_s)))

    def _hear(self) -> None:
        with contextlib.suppress(EOFError, OSError):
            while True:
                told = self._pipe.recv()
                assert isinstance(told, Watched)
                self.watched = told.topics
                self._on_change()
        self.alive = False
        self._on_change()
