"""The socket for stops alone: whatever other clients do, a stop comes through, and is answered."""

from __future__ import annotations

import contextlib
import select
import socket
import stat
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import DriverError
from hil_tests.mastctl.service_fakes import CONFIG, Hang, fake_daemon
from hil_tests.waiting import NET_S, until
from mastctl.cli.main import main
from mastctl.client import Client
from mastctl.safety import stop_socket as stop_socket_module
from mastctl.safety.state_folder import StateFolder, usual_folder
from mastctl.safety.stop_socket import NoAnswer, StopSocket, request


class Stops:
    """Records the requests; ``hook`` runs first in a stop and may raise."""

    def __init__(self) -> None:
        self.requests: list[tuple[Any, ...]] = []
        self.hook: Callable[[], Any] = lambda: None

    def __call__(self, verb: str, reason: str | None, name: str | None) -> Any:
        self.requests.append((verb, reason, name))
        if verb == "stop":
            self.hook()
            return {"stopped": True, "operation": None}
        return {"stopped": True, "latched": True, "name": name}


@pytest.fixture
def stops() -> Stops:
    return Stops()


@pytest.fixture
def server(tmp_path: Path, stops: Stops) -> Iterator[StopSocket]:
    made = StopSocket(tmp_path / "stop.sock", stops)
    yield made
    made.close()


def peer(path: Path) -> socket.socket:
    made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    made.settimeout(NET_S)
    made.connect(str(path))
    return made


def said(path: Path, data: bytes) -> str:
    """What comes back for some bytes, to the end."""
    with peer(path) as made:
        made.sendall(data)
        answer = b""
        while part := made.recv(4096):
            answer += part
        return answer.decode()


def test_one_line_is_carried_out_and_one_line_answered(server: StopSocket, stops: Stops) -> None:
    assert said(server.path, b"stop\n") == 'stop {"stopped": true, "operation": null}\n'
    assert '"latched": true' in said(server.path, b"estop Ana: sparks: many\n")
    assert said(server.path, b"estop\n").startswith("estop {")
    said(server.path, b"estop smoke\r\n")
    assert stops.requests == [
        ("stop", None, None),
        ("estop", "sparks: many", "Ana"),
        ("estop", None, None),
        ("estop", "smoke", None),
    ]


def test_a_line_that_ends_with_the_senders_side_counts(server: StopSocket) -> None:
    with peer(server.path) as made:
        made.sendall(b"stop")
        made.shutdown(socket.SHUT_WR)
        assert made.recv(4096).startswith(b"stop {")


@pytest.mark.parametrize("data", [b"\n", b"stop now\n", b"\xff\xfe\n"])
def test_what_is_no_stop_is_answered_with_what_is_expected(
    server: StopSocket, stops: Stops, data: bytes
) -> None:
    assert "where 'stop' or 'estop NAME: REASON' is expected" in said(server.path, data)
    assert stops.requests == []


def test_a_line_without_end_is_cut_off(server: StopSocket, stops: Stops) -> None:
    with contextlib.suppress(ConnectionError), peer(server.path) as made:
        made.sendall(b"x" * 100_000)
        assert made.recv(10) == b""
    assert said(server.path, b"stop\n").startswith("stop {")


def test_only_its_user_may_connect(server: StopSocket) -> None:
    assert stat.S_IMODE(server.path.stat().st_mode) == 0o600


def test_a_stop_that_fails_says_why(server: StopSocket, stops: Stops) -> None:
    def refuse() -> Any:
        raise DriverError("the cable is cut")

    stops.hook = refuse
    assert said(server.path, b"stop\n") == "failed: the cable is cut\n"
    with pytest.raises(ValueError, match="the cable is cut"):
        request(server.path, "stop")


def test_a_stop_that_hangs_keeps_no_other_out(
    server: StopSocket, stops: Stops, monkeypatch: pytest.MonkeyPatch
) -> None:
    hang = Hang()
    stops.hook = hang
    monkeypatch.setattr(stop_socket_module, "ANSWER_S", 0.1)
    with pytest.raises(NoAnswer, match="may still move"):
        request(server.path, "stop")
    assert said(server.path, b"estop Ana: sparks\n").startswith("estop {")
    hang.let_go()


def test_silent_peers_by_the_hundred_do_not_keep_a_stop_out(
    server: StopSocket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stop_socket_module._Connection, "timeout", None)
    with contextlib.ExitStack() as stack:
        for _ in range(200):
            stack.enter_context(peer(server.path))
        for _ in range(20):
            assert said(server.path, b"stop\n").startswith("stop {")


def test_silent_peers_are_left_after_a_while(server: StopSocket, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stop_socket_module._Connection, "timeout", 0.05)
    with peer(server.path) as made:
        assert select.select([made], [], [], NET_S)[0]
        assert made.recv(10) == b""


def test_a_socket_that_a_dead_daemon_left_is_replaced(tmp_path: Path, stops: Stops) -> None:
    path = tmp_path / "stop.sock"
    left = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    left.bind(str(path))
    left.close()
    server = StopSocket(path, stops)
    assert said(path, b"stop\n").startswith("stop {")
    server.close()
    until(lambda: not path.exists(), "the end")
    with pytest.raises(NoAnswer, match="no daemon listens"):
        request(path, "stop")


def test_a_daemon_whose_event_loop_is_blocked_takes_a_stop_here(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    hang = Hang()
    with fake_daemon(monkeypatch, tmp_path) as (daemon, hardware):
        path = Path(str(daemon.service.status()["stop_socket"]))
        true = type(daemon.service).status

        def status(service: Any) -> Any:  # GET /status, on the loop
            hang()
            return true(service)

        monkeypatch.setattr(type(daemon.service), "status", status)
        thread = threading.Thread(target=Client(daemon.url).status)
        thread.start()
        assert hang.entered.wait(NET_S)
        assert request(path, "estop Ana: sparks")["latched"] is True
        assert ("stop",) in hardware.head.calls
        monkeypatch.undo()
        hang.let_go()
        thread.join(NET_S)


# The command


def test_the_stop_command_prefers_the_socket_to_http(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with fake_daemon(monkeypatch, tmp_path, config=CONFIG + "state: {{folder: s}}\n") as (daemon, hardware):
        config = ["--config", str(tmp_path / "daemon.yaml")]
        assert main(["stop", *config]) == 0  # its address has port 0: nobody could know it
        assert hardware.head.calls.count(("stop",)) == 1
        assert main(["estop", "--reason", "sparks: many", "--name", "Ana: B", *config]) == 0
        assert "latched (Ana B: sparks: many)" in capsys.readouterr().out
        assert main(["reset", "--reason", "x", "--name", "y", "--url", daemon.url]) == 0
        assert "was latched by Ana B" in capsys.readouterr().out
        assert daemon.service.stop_socket is not None
        daemon.service.stop_socket.close()
        monkeypatch.setenv("MASTCTL_URL", daemon.url)
        assert main(["estop"]) == 0
        assert "latched (anonymous: no reason given)" in capsys.readouterr().out


def test_the_commands_work_with_a_broken_configuration(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("MASTCTL_URL", raising=False)
    config = tmp_path / "daemon.yaml"
    config.write_text("schema: [")
    monkeypatch.setattr("mastctl.config.load_config", None)  # it is not read at all
    other = tmp_path / "other" / "daemon.yaml"
    with contextlib.ExitStack() as stack:
        home = stack.enter_context(tempfile.TemporaryDirectory())  # a socket's path has to be short
        monkeypatch.setenv("XDG_STATE_HOME", home)
        asked = []
        for path in (config, other):
            folder = StateFolder.of(None, path, "http://127.0.0.1:8420")
            stack.callback(folder.close)
            assert folder.path == usual_folder(path, "http://127.0.0.1:8420")
            stops = Stops()
            server = StopSocket(folder.path / "stop.sock", stops)
            stack.callback(server.close)
            folder.note_daemon(path, "http://127.0.0.1:8420", server.path)
            asked.append(stops.requests)
        assert main(["stop", "--config", str(config)]) == 0
        assert asked == [[("stop", None, None)], []]
        assert main(["estop", "--config", str(config)]) == 0
        assert [len(one) for one in asked] == [2, 0]
