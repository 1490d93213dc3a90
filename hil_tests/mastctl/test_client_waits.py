"""Waits of the client: nothing is missed, whatever becomes of connection and daemon."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from hil_tests.mastctl.outside_daemon import daemon_process, line, under_way, write_config
from hil_tests.mastctl.service_fakes import ScriptedLoop, fake_step
from hil_tests.waiting import NET_S, until
from mastctl.client import Client, ClientError
from mastctl.client.connection import Broken, DaemonHttp


@pytest.fixture
def go(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Operations that end when this is set, with a step before."""
    let = threading.Event()

    def script(request: Any, record: Any, cancelled: threading.Event, devices: Any) -> Any:
        record(fake_step("look"))
        while not let.wait(0.01) and not cancelled.is_set():
            pass
        return ScriptedLoop.good(request, record, cancelled, devices)

    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(script))
    return let


def test_a_wait_shows_each_step_as_it_comes(client: Client, go: threading.Event) -> None:
    operation, steps = client.point(pan_rad=0.0, tilt_rad=0.0), list[str]()
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(client.wait, operation, NET_S, lambda step: steps.append(step["name"]))
        until(lambda: steps == ["look"], "the first step")
        go.set()
        assert waiting.result(NET_S)["state"] == "done"
    assert steps == ["look", "look", "measure"]


def test_a_daemon_killed_while_a_client_waits_is_one_plain_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    request, waits = DaemonHttp.request, threading.Event()

    def noted(self: DaemonHttp, method: str, path: str, **options: Any) -> Any:
        answer = request(self, method, path, **options)
        if "/operations/" in path:
            waits.set()
        return answer

    monkeypatch.setattr(DaemonHttp, "request", noted)
    with (
        daemon_process(tmp_path, write_config(tmp_path)) as daemon,
        Client(line(daemon)) as client,
        Client(client.url) as waiter,
        ThreadPoolExecutor(1) as pool,
    ):
        under_way(client)
        operation = client.status()["operation"]
        waiting = pool.submit(waiter.wait, operation, 2.0 * NET_S)
        assert waits.wait(NET_S)
        daemon.kill()
        with pytest.raises(ClientError) as told:
            waiting.result(NET_S)  # it does not wait for its whole time
    assert told.value.code == "no_daemon"
    assert "\n" not in str(told.value)
    assert "no daemon answers at" in str(told.value)


def test_a_wait_goes_on_where_an_answer_is_lost(
    client: Client, go: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    operation = client.point(pan_rad=0.0, tilt_rad=0.0)
    request, sent = DaemonHttp.request, list[str]()

    def lossy(self: DaemonHttp, method: str, path: str, **options: Any) -> Any:
        sent.append(path)
        if len(sent) in (2, 3):
            raise Broken("no_daemon", "the connection broke")
        if len(sent) == 4:
            go.set()
        return request(self, method, path, **options)

    monkeypatch.setattr(DaemonHttp, "request", lossy)
    assert client.wait(operation, timeout_s=NET_S)["state"] == "done"
    assert len(sent) >= 4


def test_a_wait_on_a_daemon_that_hangs_ends_with_its_time() -> None:
    ended = threading.Event()

    def hang(listener: socket.socket) -> None:
        connection, _ = listener.accept()
        with connection:
            connection.recv(65536)
            ended.wait(NET_S / 3)  # less than the usual patience with one request

    with socket.create_server(("127.0.0.1", 0)) as listener, ThreadPoolExecutor(1) as pool:
        hangs = pool.submit(hang, listener)
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        with Client(url) as client, pytest.raises(ClientError, match="took the request but did not") as told:
            client.wait("000001", 0.2)
        hung = not hangs.done()
        ended.set()
    assert told.value.code == "timeout" and hung


def test_importing_the_client_loads_no_image_library() -> None:
    program = "import sys, mastctl.client; print([n for n in ('cv2', 'numpy', 'scipy') if n in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
