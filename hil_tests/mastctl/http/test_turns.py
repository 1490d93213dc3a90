"""A stop passes whatever else was asked for before it; what costs much is made once, by few, or later."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from urllib.parse import urlsplit

import pytest

from hil_tests.mastctl.service_fakes import FakeHardware
from hil_tests.waiting import NET_S, until
from mastctl.control.publisher import Publisher
from mastctl.daemon import RunningDaemon
from mastctl.http import guard as guard_module
from mastctl.http.waiting import Waiting
from mastctl.web import events as events_module

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
    whole = guard_module.Guard._http

    async def noted(self: Any, scope: Any, receive: Any, send: Any) -> None:
        if scope["path"] == "/hold":  # the event loop stands until everybody has asked
            held.set()
            let_go.wait(NET_S)
        else:
            handled.append(scope["path"])
        await whole(self, scope, receive, send)

    monkeypatch.setattr(guard_module.Guard, "_http", noted)

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


def test_what_costs_much_is_made_by_few_and_after_everybody_else() -> None:
    many, count = 12, threading.Lock()
    at_once = most = 0
    nice = set[int]()
    both = threading.Barrier(2, timeout=NET_S)

    def encode() -> int:
        nonlocal at_once, most
        with count:
            at_once += 1
            most = max(most, at_once)
        nice.add(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))
        both.wait()
        with count:
            at_once -= 1
        return 1

    async def made() -> Waiting:
        return Waiting()

    waiting = asyncio.run(made())
    with ThreadPoolExecutor(many) as asking:
        assert sum(asking.map(lambda _: waiting.encode(encode), range(many))) == many
    waiting.end()
    assert most == 2
    assert min(nice) > os.getpriority(os.PRIO_PROCESS, 0)


def test_the_text_of_an_event_is_made_once_for_all_who_listen(
    pair: tuple[RunningDaemon, FakeHardware], monkeypatch: pytest.MonkeyPatch
) -> None:
    service, made = pair[0].service, list[int]()
    whole = events_module.value_told

    def counted(*asked: Any) -> Any:
        made.append(1)
        return whole(*asked)

    monkeypatch.setattr(events_module, "value_told", counted)
    publisher = Publisher()
    with publisher.subscribe("mast") as news:
        publisher.publish("mast", "in_use", {"path": "a"})
        (one,) = news.wait(NET_S)
    told = [events_module._event(service, one, lost) for lost in range(3)]
    assert len(set(told)) == 3
    assert made == [1]


def test_who_publishes_calls_the_loop_once_however_many_listen() -> None:
    async def listened() -> tuple[int, int]:
        loop, calls = asyncio.get_running_loop(), 0
        publisher = Publisher()
        listeners = [publisher.subscribe_here("mast") for _ in range(20)]
        threadsafe = loop.call_soon_threadsafe

        def counted(*asked: Any, **others: Any) -> Any:
            nonlocal calls
            calls += 1
            return threadsafe(*asked, **others)

        loop.call_soon_threadsafe = counted  # type: ignore[method-assign]
        publisher.publish("mast", "in_use", {})
        asked = calls
        heard = [await one.wait(NET_S) for one in listeners]
        return asked, sum(map(len, heard))

    assert asyncio.run(listened()) == (1, 20)
