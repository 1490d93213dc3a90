"""Waits of the client: by events, nothing missed, whatever becomes of stream and daemon."""

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
from hil_tests.mastctl.service_fakes import FakeHardware, ScriptedLoop, fake_step
from hil_tests.waiting import NET_S, until
from mastctl.client import Client, ClientError
from mastctl.client import connection as connection_module
from mastctl.daemon import RunningDaemon

BOTH = tuple[RunningDaemon, FakeHardware]


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


def asked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Paths of the requests that this process's clients send."""
    paths: list[str] = []
    plain = connection_module.DaemonHttp.send

    def send(self: Any, method: str, path: str, **options: Any) -> Any:
        paths.append(f"{method} {path}")
        return plain(self, method, path, **options)

    monkeypatch.setattr(connection_module.DaemonHttp, "send", send)
    return paths


def test_a_wait_asks_once_and_then_listens(
    client: Client, go: threading.Event, pair: BOTH, monkeypatch: pytest.MonkeyPatch
) -> None:
    operation = client.point(pan_rad=0.0, tilt_rad=0.0)
    paths, steps = asked(monkeypatch), []
    publisher = pair[0].service.machine.publisher
    before = publisher.listeners

    def on_step(step: Any) -> None:
        steps.append(step["name"])

    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(client.wait, operation, NET_S, on_step)
        until(lambda: publisher.listeners > before and steps == ["look"], "it listens")
        go.set()
        assert waiting.result(NET_S)["state"] == "done"
    assert steps == ["look", "look", "measure"]
    assert paths == [f"GET /api/v1/operations/{operation}"]


def test_an_end_between_the_question_and_the_subscription_is_not_missed(
    client: Client, go: threading.Event, pair: BOTH, monkeypatch: pytest.MonkeyPatch
) -> None:
    operation = client.point(pan_rad=0.0, tilt_rad=0.0)
    operations, heard = pair[0].service.operations, connection_module.DaemonHttp.heard

    def after_the_end(self: Any, *args: Any) -> Any:
        go.set()
        until(lambda: operations.get(operation).state == "done", "it has ended")
        return heard(self, *args)

    monkeypatch.setattr(connection_module.DaemonHttp, "heard", after_the_end)
    assert client.wait(operation, timeout_s=NET_S)["state"] == "done"


def test_a_daemon_killed_while_a_client_listens_is_one_plain_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard, listens = connection_module.DaemonHttp.heard, threading.Event()

    def noted(self: Any, *args: Any) -> Any:
        for event in heard(self, *args):
            listens.set()
            yield event

    monkeypatch.setattr(connection_module.DaemonHttp, "heard", noted)
    with (
        daemon_process(tmp_path, write_config(tmp_path)) as daemon,
        Client(line(daemon)) as client,
        Client(client.url) as waiter,
        ThreadPoolExecutor(1) as pool,
    ):
        under_way(client)
        operation = client.status()["operation"]
        waiting = pool.submit(waiter.wait, operation, 2.0 * NET_S)
        assert listens.wait(NET_S)
        daemon.kill()
        with pytest.raises(ClientError) as told:
            waiting.result(NET_S)  # it does not wait for its whole time
    assert told.value.code == "no_daemon"
    assert "\n" not in str(told.value)
    assert "no daemon answers at" in str(told.value)


def test_a_stream_that_breaks_is_begun_again(
    client: Client, go: threading.Event, pair: BOTH, monkeypatch: pytest.MonkeyPatch
) -> None:
    operation = client.point(pan_rad=0.0, tilt_rad=0.0)
    heard = connection_module.DaemonHttp.heard
    broken: list[Any] = []

    def breaking(self: Any, *args: Any) -> Any:
        for event in heard(self, *args):
            yield event
            if len(broken) < 2:
                broken.append(event)
                raise connection_module.Broken("no_daemon", "the connection broke")
            go.set()

    monkeypatch.setattr(connection_module.DaemonHttp, "heard", breaking)
    assert client.wait(operation, timeout_s=NET_S)["state"] == "done"
    assert len(broken) == 2


def test_a_state_is_waited_for(client: Client, go: threading.Event) -> None:
    words: list[str] = []
    client.point(pan_rad=0.0, tilt_rad=0.0)
    client.wait_state("moving", timeout_s=NET_S)
    go.set()
    told = client.wait_state("ready", timeout_s=NET_S, on_change=lambda one: words.append(one["state"]))
    assert told["state"] == words[-1] == "ready"
    with pytest.raises(ClientError, match=r"the state is ready and not stopped after 0\.2 s"):
        client.wait_state("stopped", timeout_s=0.2)


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
