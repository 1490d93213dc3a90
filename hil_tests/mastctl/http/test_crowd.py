"""Many at once: dead cameras, waiting requests, silent connections keep nobody else out."""

from __future__ import annotations

import contextlib
import resource
import signal
import socket
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from hil_tests.mastctl.outside_daemon import (
    daemon_process,
    line,
    stands_short_of_its_goal,
    under_way,
    write_config,
)
from hil_tests.mastctl.service_fakes import fake_daemon
from hil_tests.waiting import NET_S, joined, until
from mastctl import daemon as daemon_module
from mastctl.client import Client, ClientError
from mastctl.http.waiting import Streams


def in_threads(count: int, ask: Callable[[], Any]) -> list[threading.Thread]:
    made = [threading.Thread(target=ask) for _ in range(count)]
    for one in made:
        one.start()
    return made


def test_requests_that_wait_when_the_daemon_ends_are_refused(tmp_path: Path) -> None:
    codes: list[str] = []
    with daemon_process(tmp_path, write_config(tmp_path)) as daemon:
        url = line(daemon)

        def ask() -> None:
            with Client(url) as client:
                try:
                    client.snapshot("navcam_left", fresh=True)
                except ClientError as error:
                    codes.append(error.code)

        asking = in_threads(5, ask)
        until(lambda: codes == ["too_many"], "four wait, and the fifth is refused for it")
        daemon.send_signal(signal.SIGTERM)
        joined(*asking)
        _, log = daemon.communicate(timeout=NET_S)
    assert codes == ["too_many"] + ["closing"] * 4
    assert daemon.returncode == 0, log
    assert not {"Traceback", "ERROR"} & set(log.replace(":", " ").split()), log
    assert "next_frame did not end" not in log, "nobody waited for the picture's own deadline"


SILENT = 70
DESCRIPTORS = 64


def few_descriptors() -> None:
    resource.setrlimit(resource.RLIMIT_NOFILE, (DESCRIPTORS, DESCRIPTORS))


@pytest.mark.parametrize("begun", [b"", b"POST /api/v1/stop HT"], ids=["silent", "slow"])
def test_a_stop_passes_more_silent_connections_than_descriptors(tmp_path: Path, begun: bytes) -> None:
    with daemon_process(tmp_path, write_config(tmp_path), prepare=few_descriptors) as daemon:
        url = line(daemon)
        host, port = url.removeprefix("http://").split(":")
        with contextlib.ExitStack() as open_ones:
            with Client(url) as client:
                under_way(client)
            for _ in range(SILENT):
                one = open_ones.enter_context(socket.create_connection((host, int(port)), timeout=NET_S))
                with contextlib.suppress(OSError):
                    one.sendall(begun)
            with Client(url, timeout_s=NET_S) as client:
                assert client.stop()["operation"] is not None, "it came while the head was under way"
                stands_short_of_its_goal(client)
        daemon.send_signal(signal.SIGTERM)
        _, log = daemon.communicate(timeout=NET_S)
        assert "Traceback" not in log, log


def get(connection: socket.socket, path: str, method: str = "GET") -> bytes:
    """Ask on a connection of one's own and return the beginning of the answer."""
    connection.sendall(f"{method} /api/v1{path} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
    return connection.recv(65536)


def test_stop_and_status_are_served_when_all_connections_work(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(daemon_module, "most_connections", lambda: 8)
    monkeypatch.setattr(daemon_module, "Streams", lambda publisher, most: Streams(publisher, 8))
    with fake_daemon(monkeypatch, tmp_path) as (daemon, hardware), contextlib.ExitStack() as open_ones:
        host, port = daemon.url.removeprefix("http://").split(":")

        def connection() -> socket.socket:
            return open_ones.enter_context(socket.create_connection((host, int(port)), timeout=NET_S))

        streams = [connection() for _ in range(8)]
        for one in streams:
            assert b"200 OK" in get(one, "/track/stream")
        refused = get(connection(), "/operations")
        assert b"503" in refused
        assert b"retry-after" in refused
        for stop in ("/stop", "/stop/", "//stop", "/estop/"):
            hardware.head.calls.clear()
            with socket.create_connection((host, int(port)), timeout=NET_S) as one:
                one.sendall(f"POST /api/v1{stop} HTTP/1.0\r\n\r\n".encode())
                answer = b"".join(iter(partial(one.recv, 65536), b""))  # closed: the next is one too many
            assert b"200 OK" in answer
            assert ("stop",) in hardware.head.calls
        assert b"200 OK" in get(connection(), "/status")
