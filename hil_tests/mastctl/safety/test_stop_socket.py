"""The socket for stops alone: whoever sits there in silence, a stop comes through, and is answered."""

from __future__ import annotations

import contextlib
import os
import resource
import select
import socket
import stat
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import DriverError
from hil_tests.mastctl.service_fakes import CONFIG, Hang, fake_daemon
from hil_tests.waiting import NET_S, until
from mastctl.cli.main import main
from mastctl.client import Client
from mastctl.errors import MastctlError
from mastctl.safety import stop_socket as stop_socket_module
from mastctl.safety import stop_threads as stop_threads_module
from mastctl.safety.state_folder import StateFolder, usual_folder
from mastctl.safety.stop_line import NoAnswer, ask
from mastctl.safety.stop_socket import SILENT_PEERS, StopSocket


class Stops:
    """Counts what it is asked for."""

    def __init__(self) -> None:
        self.asked: list[tuple[Any, ...]] = []
        self.latched: list[tuple[Any, ...]] = []

    def stop_told(self) -> dict[str, Any]:
        self.asked.append(("stop",))
        return {"stopped": True, "operation": None}

    def estop(self, reason: str | None, name: str | None) -> dict[str, Any]:
        self.asked.append(("estop", reason, name))
        return {"stopped": True, "latched": True, "name": name}

    def latch_estop(self, reason: str | None, name: str | None) -> None:
        self.latched.append((reason, name))


@pytest.fixture
def stops() -> Stops:
    return Stops()


@pytest.fixture
def door(tmp_path: Path, stops: Stops) -> Iterator[StopSocket]:
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


def test_one_line_is_carried_out_and_one_line_answered(door: StopSocket, stops: Stops) -> None:
    assert said(door.path, b"stop\n") == 'stop {"stopped": true, "operation": null}\n'
    assert '"latched": true' in said(door.path, b"estop Ana: sparks: many\n")
    assert said(door.path, b"estop\n").startswith("estop {")
    said(door.path, b"estop smoke\r\n")
    assert stops.asked == [
        ("stop",), ("estop", "sparks: many", "Ana"), ("estop", None, None), ("estop", "smoke", None),
    ]  # fmt: skip
    assert stops.latched == [("sparks: many", "Ana"), (None, None), ("smoke", None)]


def test_a_line_that_ends_with_the_senders_side_counts(door: StopSocket) -> None:
    with peer(door.path) as made:
        made.sendall(b"stop")
        made.shutdown(socket.SHUT_WR)
        assert made.recv(4096).startswith(b"stop {")


def test_a_line_may_come_in_pieces_and_only_the_first_counts(door: StopSocket, stops: Stops) -> None:
    with peer(door.path) as made:
        for piece in (b"s", b"to", b"p\nstop\nestop x: y\n"):
            made.sendall(piece)
            time.sleep(0.02)
        assert made.recv(4096).startswith(b"stop {")
    assert stops.asked == [("stop",)]


@pytest.mark.parametrize("data", [b"\n", b"go\n", b"stop now\n", b"\xff\xfe\n", b"GET / HTTP/1.1\r\n\r\n"])
def test_what_is_no_stop_is_told_what_is_expected(door: StopSocket, stops: Stops, data: bytes) -> None:
    assert "where 'stop' or 'estop NAME: REASON' is expected" in said(door.path, data)
    assert stops.asked == []


def test_a_line_without_end_is_cut_off(door: StopSocket, stops: Stops) -> None:
    with contextlib.suppress(ConnectionError), peer(door.path) as made:
        made.sendall(b"x" * 100_000)
        assert made.recv(10) == b""
    assert said(door.path, b"stop\n").startswith("stop {")


def test_only_its_user_may_connect(door: StopSocket) -> None:
    assert stat.S_IMODE(door.path.stat().st_mode) == 0o600


def test_it_leaves_the_umask_alone_which_is_every_threads(
    tmp_path: Path, stops: Stops, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Two threads that change it at once and back can leave 0o177 behind.
    monkeypatch.setattr(os, "umask", lambda mask: pytest.fail(f"umask {mask:#o}"))
    made = StopSocket(tmp_path / "stop.sock", stops)
    assert stat.S_IMODE(made.path.stat().st_mode) == 0o600
    made.close()


def test_a_stop_that_fails_is_told(door: StopSocket, stops: Stops, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> dict[str, Any]:
        raise DriverError("the cable is cut")

    monkeypatch.setattr(stops, "stop_told", refuse)
    assert said(door.path, b"stop\n") == "failed: the cable is cut\n"
    with pytest.raises(ValueError, match="the cable is cut"):
        ask(door.path, "stop")


def test_a_stop_that_hangs_is_told_in_time_and_the_next_still_latches(
    door: StopSocket, stops: Stops, monkeypatch: pytest.MonkeyPatch
) -> None:
    hang = Hang()
    monkeypatch.setattr(stops, "stop_told", hang)
    monkeypatch.setattr(stop_socket_module, "ANSWER_S", 0.1)
    for _ in range(stop_socket_module.THREADS):
        assert "may still move" in said(door.path, b"stop\n")
    assert "may still move" in said(door.path, b"estop Ana: sparks\n")
    assert stops.latched == [("sparks", "Ana")]
    hang.let_go()


def test_a_stop_that_no_thread_can_send_any_more_is_told_at_once(
    door: StopSocket, stops: Stops, monkeypatch: pytest.MonkeyPatch
) -> None:
    hang = Hang()
    monkeypatch.setattr(stops, "stop_told", hang)
    monkeypatch.setattr(stop_threads_module, "OVERDUE_S", -1.0)
    senders = [peer(door.path) for _ in range(stop_socket_module.THREADS)]
    for count, sender in enumerate(senders, 1):
        sender.sendall(b"stop\n")
        until(lambda count=count: len(door._threads._began_s) == count, "the stop is under way")
    told = said(door.path, b"estop Ana: sparks\n")
    assert told.startswith(f"failed: {len(senders)} stops are under way") and "switch its power off" in told
    assert stops.latched == [("sparks", "Ana")]
    hang.let_go()
    for sender in senders:
        sender.close()


def test_who_goes_before_the_answer_hurts_nobody(
    door: StopSocket, stops: Stops, monkeypatch: pytest.MonkeyPatch
) -> None:
    hang = Hang()
    monkeypatch.setattr(stops, "stop_told", hang)
    with peer(door.path) as made:
        made.sendall(b"stop\n")
        until(lambda: door._threads._began_s, "the stop is under way")
    hang.let_go()
    monkeypatch.undo()
    assert said(door.path, b"stop\n").startswith("stop {")


def test_silent_peers_by_the_hundred_do_not_keep_a_stop_out(door: StopSocket) -> None:
    with contextlib.ExitStack() as stack:
        for _ in range(500):
            stack.enter_context(peer(door.path))
        for _ in range(20):
            assert said(door.path, b"stop\n").startswith("stop {")
        until(lambda: len(door._peers) <= SILENT_PEERS, "the oldest go")


def test_silent_peers_who_come_again_and_again_do_not_keep_a_stop_out(door: StopSocket) -> None:
    ended = threading.Event()

    def crowd() -> None:
        while not ended.is_set():
            held = []
            with contextlib.suppress(OSError):
                for _ in range(100):
                    held.append(peer(door.path))
            for one in held:
                one.close()

    threads = [threading.Thread(target=crowd) for _ in range(3)]
    for thread in threads:
        thread.start()
    try:
        for _ in range(8):
            assert ask(door.path, "stop")["stopped"] is True
    finally:
        ended.set()
        for thread in threads:
            thread.join(NET_S)


def test_silent_peers_are_left_after_a_while(door: StopSocket, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stop_socket_module, "SILENT_S", 0.05)
    with peer(door.path) as made:
        assert select.select([made], [], [], NET_S)[0]
        assert made.recv(10) == b""


def test_a_process_without_descriptors_still_takes_stops(door: StopSocket) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    held: list[int] = []
    until(lambda: len(door._spares) == stop_socket_module.SPARES, "the descriptors that are kept")
    ends = [socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) for _ in range(30)]  # the peers' own
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (256, hard))
        with contextlib.suppress(OSError):
            while True:
                held.append(os.open(os.devnull, os.O_RDONLY))
        for end in ends:
            end.settimeout(NET_S)
            end.connect(str(door.path))
            end.sendall(b"stop\n")
            assert end.recv(4096).startswith(b"stop {")
    finally:
        for descriptor in held:
            os.close(descriptor)
        for end in ends:
            end.close()
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_a_socket_that_a_dead_daemon_left_is_replaced(tmp_path: Path, stops: Stops) -> None:
    path = tmp_path / "stop.sock"
    left = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    left.bind(str(path))
    left.close()
    door = StopSocket(path, stops)
    assert said(path, b"stop\n").startswith("stop {")
    door.close()
    until(lambda: not path.exists(), "the end")
    with pytest.raises(NoAnswer, match="no daemon listens"):
        ask(path, "stop")


def test_a_path_that_is_too_long_is_told(tmp_path: Path, stops: Stops) -> None:
    with pytest.raises(MastctlError, match="is longer than the 100 bytes"):
        StopSocket(tmp_path / ("x" * 100) / "stop.sock", stops)


def test_a_daemon_whose_event_loop_is_blocked_takes_a_stop_here(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    hang = Hang()
    with fake_daemon(monkeypatch, tmp_path) as (daemon, hardware):
        path = Path(str(daemon.service.state().told()["stop_socket"]))
        true = type(daemon.service).state

        def state(service: Any) -> Any:  # GET /status, on the loop
            hang()
            return true(service)

        monkeypatch.setattr(type(daemon.service), "state", state)
        thread = threading.Thread(target=Client(daemon.url).status)
        thread.start()
        assert hang.entered.wait(NET_S)
        assert ask(path, "estop Ana: sparks")["latched"] is True
        assert ("stop",) in hardware.head.calls
        monkeypatch.undo()
        hang.let_go()
        thread.join(NET_S)


# The command


def test_the_command_takes_the_socket_where_there_is_one_and_http_where_not(
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
            door = StopSocket(folder.path / "stop.sock", stops)
            stack.callback(door.close)
            folder.note_daemon(path, "http://127.0.0.1:8420", door.path)
            asked.append(stops.asked)
        assert main(["stop", "--config", str(config)]) == 0
        assert asked == [[("stop",)], []]
        assert main(["estop", "--config", str(config)]) == 0
        assert [len(one) for one in asked] == [2, 0]


def test_where_nobody_is_found_the_usual_address_is_asked_in_spite_of_a_broken_configuration(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "home"))
    monkeypatch.delenv("MASTCTL_URL", raising=False)
    (tmp_path / "daemon.yaml").write_text("schema: [")
    code = main(["stop", "--config", str(tmp_path / "daemon.yaml")])
    words = capsys.readouterr().err
    assert "asking the usual address http://127.0.0.1:8420" in words
    assert code in (0, 1)  # somebody may listen there
