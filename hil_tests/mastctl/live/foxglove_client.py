"""A viewer that speaks Foxglove's WebSocket protocol from its description, without the library under test."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
import time
from dataclasses import dataclass, field
from typing import Any

PROTOCOL = "foxglove.sdk.v1"


@dataclass
class Viewer:
    """One connection; `subscribe` and `read` are all that a viewer does."""

    port: int
    origin: str = "https://app.foxglove.dev"
    channels: dict[str, dict[str, Any]] = field(default_factory=dict)
    server: dict[str, Any] = field(default_factory=dict)
    statuses: list[dict[str, Any]] = field(default_factory=list)
    messages: list[tuple[str, int, bytes]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._socket = socket.create_connection(("127.0.0.1", self.port), timeout=60.0)
        key = base64.b64encode(os.urandom(16)).decode()
        lines = (
            "GET / HTTP/1.1", f"Host: 127.0.0.1:{self.port}", "Upgrade: websocket", "Connection: Upgrade",
            f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Version: 13", f"Sec-WebSocket-Protocol: {PROTOCOL}",
            f"Origin: {self.origin}", "", "",
        )  # fmt: skip
        self._socket.sendall("\r\n".join(lines).encode())
        self._buffer = b""
        while b"\r\n\r\n" not in self._buffer:
            self._buffer += self._received()
        head, _, self._buffer = self._buffer.partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 101") and PROTOCOL.encode() in head, head
        self._topics: dict[int, str] = {}

    def close(self) -> None:
        self._socket.close()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def tell(self, **what: Any) -> None:
        self._send(1, json.dumps(what).encode())

    def subscribe(self, *topics: str) -> None:
        wanted = []
        for topic in topics:
            number = len(self._topics) + 1
            self._topics[number] = topic
            wanted.append({"id": number, "channelId": self.channels[topic]["id"]})
        self.tell(op="subscribe", subscriptions=wanted)

    def unsubscribe(self, topic: str) -> None:
        (number,) = (at for at, name in self._topics.items() if name == topic)
        self.tell(op="unsubscribe", subscriptionIds=[number])

    def read(self, until: Any, seconds: float = 60.0) -> None:
        """Read until ``until(self)`` is true."""
        end_s = time.monotonic() + seconds
        while not until(self):
            assert time.monotonic() < end_s, (sorted(self.channels), len(self.messages), self.statuses)
            self._take_in(*self._frame())

    def of(self, topic: str) -> list[bytes]:
        return [data for name, _, data in self.messages if name == topic]

    def _take_in(self, kind: int, data: bytes) -> None:
        if kind == 2:
            assert data[0] == 1, "message data, by the protocol"
            number, time_ns = struct.unpack_from("<IQ", data, 1)
            self.messages.append((self._topics[number], time_ns, data[13:]))
        elif kind == 1:
            told = json.loads(data)
            if told["op"] == "serverInfo":
                self.server = told
            elif told["op"] == "advertise":
                self.channels |= {one["topic"]: one for one in told["channels"]}
            elif told["op"] == "unadvertise":
                gone = set(told["channelIds"])
                self.channels = {name: one for name, one in self.channels.items() if one["id"] not in gone}
            elif told["op"] == "status":
                self.statuses.append(told)
        elif kind == 9:
            self._send(10, data)

    def _frame(self) -> tuple[int, bytes]:
        first, length = self._exactly(2)
        assert first & 0x80, "whole frames"
        if length == 126:
            (length,) = struct.unpack(">H", self._exactly(2))
        elif length == 127:
            (length,) = struct.unpack(">Q", self._exactly(8))
        return first & 15, self._exactly(length)

    def _exactly(self, count: int) -> bytes:
        while len(self._buffer) < count:
            self._buffer += self._received()
        data, self._buffer = self._buffer[:count], self._buffer[count:]
        return data

    def _received(self) -> bytes:
        data = self._socket.recv(1 << 20)
        if not data:
            raise ConnectionError("the server closed the connection")
        return data

    def _send(self, kind: int, data: bytes) -> None:
        length = bytes([0x80 | len(data)]) if len(data) < 126 else b"\xfe" + struct.pack(">H", len(data))
        self._socket.sendall(bytes([0x80 | kind]) + length + b"\0\0\0\0" + data)
