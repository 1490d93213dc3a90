"""The process that speaks to Foxglove and Lichtblick, which can do nothing but show what it is sent.

Its server lets in everybody who reaches the port, so it stands apart from the daemon: connections that use up
its descriptors, viewers that use up its memory and whatever else is wrong with it stay in here. It ends when
the daemon does, however that happens: then its connection to it ends.
"""

from __future__ import annotations

import contextlib
import logging
import os
import resource
import socket
import sys
import threading
import time
from multiprocessing.connection import Connection
from pathlib import Path

import foxglove
from foxglove import Channel, Context, Schema
from foxglove.websocket import ChannelView, Client, ServerListener

from mastctl.live.wire import Close, Listening, Message, Open, Watched

NAME = "mastctl"
MOST_DESCRIPTORS = 48
"""Leaves room for some thirty viewers."""

BACKLOG = 64
"""Messages that wait for a slow viewer; then its oldest goes."""

LISTENS_S = 1.0
TOGETHER_S = 0.05
"""A viewer asks for its topics one by one; they are told together."""


class _Viewers(ServerListener):
    """Tells the daemon what is watched."""

    def __init__(self, daemon: Connection) -> None:
        self._daemon = daemon
        self._lock = threading.Lock()
        self._watched: dict[tuple[int, int], str] = {}
        self._changed = threading.Event()
        threading.Thread(target=self._tell, daemon=True).start()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        with self._lock:
            self._watched[client.id, channel.id] = channel.topic
        self._changed.set()

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        with self._lock:
            self._watched.pop((client.id, channel.id), None)
        self._changed.set()

    def _tell(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                self._changed.wait()
                time.sleep(TOGETHER_S)
                self._changed.clear()
                with self._lock:
                    topics = frozenset(self._watched.values())
                self._daemon.send(Watched(topics))


def serve(daemon: Connection, host: str, port: int) -> None:
    """Show what comes until the daemon is gone."""
    context = Context()
    viewers = _Viewers(daemon)
    try:
        server = foxglove.start_server(
            name=NAME,
            host=host,
            port=port,
            capabilities=[],  # nobody publishes, sets or calls anything here
            server_listener=viewers,
            context=context,
            message_backlog_size=BACKLOG,
        )
    except RuntimeError as error:
        daemon.send(Listening(refused=str(error)))
        return
    threading.Thread(target=_end_if_deaf, args=(_listener(server.port),), daemon=True).start()
    daemon.send(Listening(server.port))
    channels: dict[str, Channel] = {}
    while True:
        match daemon.recv():
            case Open(topic, encoding, name, schema_encoding, data):
                schema = Schema(name=name, encoding=schema_encoding, data=data)
                channels[topic] = Channel(topic, message_encoding=encoding, schema=schema, context=context)
            case Close(topic):
                channels.pop(topic).close()
            case Message(topic, data, time_ns):
                channels[topic].log(data, log_time=time_ns)


def _listener(port: int) -> int:
    """Return the descriptor at which the server listens."""
    for entry in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):  # what is no socket, or is closed meanwhile
            one = socket.socket(fileno=int(entry.name))
            found = one.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN) and one.getsockname()[1] == port
            number = one.detach()  # it is the server's
            if found:
                return number
    raise OSError(f"nothing listens at port {port}")


def _end_if_deaf(listener: int) -> None:
    """End when the server has stopped listening, as it does once it is out of descriptors."""
    known = os.fstat(listener).st_ino
    with contextlib.suppress(OSError):
        while os.fstat(listener).st_ino == known:
            time.sleep(LISTENS_S)
    os._exit(1)  # the daemon starts another one


def _stand_back() -> None:
    """Let the daemon go first: at descriptors, at memory and at the processor."""
    resource.setrlimit(resource.RLIMIT_NOFILE, (MOST_DESCRIPTORS, MOST_DESCRIPTORS))
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")
    os.nice(5)


if __name__ == "__main__":
    logging.disable()  # a viewer that goes away is not worth a line
    _stand_back()
    with contextlib.suppress(EOFError, OSError):
        serve(Connection(int(sys.argv[1])), sys.argv[2], int(sys.argv[3]))
    os._exit(0)  # without waiting for viewers
