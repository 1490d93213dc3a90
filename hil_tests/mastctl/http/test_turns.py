"""A stop passes whatever else was asked for before it; what costs much is made once, by few, or later."""

from __future__ import annotations

import contextlib
import socket
import threading
from typing import Any
from urllib.parse import urlsplit

import pytest

from hil_tests.mastctl.service_fakes import FakeHardware
from hil_tests.waiting import NET_S, until
from mastctl.daemon import RunningDaemon
from mastctl.http.guard import Guard

CROWD = 40


@pytest.mark.parametrize(
    "stop", ["/api/v1/stop", "/api/v1/estop", "//api/v1/stop/", "http://rover/api/v1/estop"]
)
def test_a_stop_passes_what_came_before_it(
    pair: tuple[RunningDaemon, FakeHardware], monkeypatch: pytest.MonkeyPatch, stop: str
) -> None:
    port = urlsplit(pair[0].url).port
    handled: list[str] = []
    held, let_go = threading.Event(), threading.Event()
    whole = Guard.__call__

    async def noted(self: Any, scope: Any, receive: Any, send: Any) -> None:
        if scope["path"] == "/hold":  # the event loop stands until everybody has asked
            held.set()
            let_go.wait(NET_S)
        else:
            handled.append(scope["path"])
        await whole(self, scope, receive, send)

    monkeypatch.setattr(Guard, "__call__", noted)

    def ask(line: socket.socket, method: str, path: str) -> None:
        line.sendall(f"{method} {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 0\r\n\r\n".encode())

    with contextlib.ExitStack() as lines:
        crowd = [
            lines.enter_context(socket.create_connection(("127.0.0.1", port), timeout=NET_S))
            for _ in range(CROWD + 2)
        ]
        for line in crowd:  # each is known to the daemon
            ask(line, "GET", "/api/v1/health/live")
            line.recv(4096)
        handled.clear()
        ask(crowd[0], "GET", "/hold")
        assert held.wait(NET_S)
        for line in crowd[1:-1]:
            ask(line, "GET", "/openapi.json")
        ask(crowd[-1], "POST", stop)
        let_go.set()
        until(lambda: len(handled) == CROWD + 1, "all requests")
    assert handled.index(stop) < 3, f"the stop was taken up after {handled.index(stop)} others"
