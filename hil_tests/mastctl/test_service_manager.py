"""What a service manager receives: datagrams as sd_notify(3) has them, to a socket of the test's own."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from hil_tests.mastctl.outside_daemon import OUTSIDE, daemon_process, write_config
from hil_tests.waiting import NET_S
from mastctl.daemon import ServiceManager


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[socket.socket]:
    """The manager's end."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        listener.setblocking(False)
        yield listener


def messages(listener: socket.socket) -> list[str]:
    """Everything that was sent so far."""
    found = []
    while True:
        try:
            found.append(listener.recv(4096).decode())
        except BlockingIOError:
            return found


def environment(listener: socket.socket, **more: str) -> dict[str, str]:
    return {"NOTIFY_SOCKET": listener.getsockname(), **more}


def test_each_message_is_a_datagram_as_the_protocol_has_it(manager: socket.socket) -> None:
    service = ServiceManager(environment(manager), Loop().soon)
    service.send("READY=1")
    service.send("STATUS=moving:\n two  lines")
    assert messages(manager) == ["READY=1", "STATUS=moving: two lines"]


@pytest.mark.parametrize(
    ("variables", "watched"),
    [
        ({"WATCHDOG_USEC": "10000000"}, True),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": str(os.getpid())}, True),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": "1"}, False),  # another process is watched
        ({"WATCHDOG_USEC": "0"}, False),
        ({"WATCHDOG_USEC": "soon"}, False),
        ({}, False),
    ],
    ids=["any", "this", "another", "never", "soon", "none"],
)
def test_only_the_process_that_is_meant_is_watched(
    manager: socket.socket, variables: dict[str, str], watched: bool
) -> None:
    loop = Loop()
    ServiceManager(environment(manager, **variables), loop.soon).turn()
    loop.run()
    assert messages(manager) == ["WATCHDOG=1"] * watched


class Loop:
    """An event loop that comes to what it was given when the test says so."""

    def __init__(self) -> None:
        self.waiting: list[Callable[[], None]] = []
        self.ended = False

    def soon(self, function: Callable[[], None]) -> None:
        if self.ended:
            raise RuntimeError("Event loop is closed")
        self.waiting.append(function)

    def run(self) -> None:
        waiting, self.waiting = self.waiting, []
        for function in waiting:
            function()


def test_a_sign_of_life_needs_a_turn_of_the_head_and_one_of_the_loop(manager: socket.socket) -> None:
    now, loop = [0.0], Loop()
    beat = ServiceManager(environment(manager, WATCHDOG_USEC="8000000"), loop.soon, lambda: now[0])
    loop.run()
    assert messages(manager) == []  # the loop alone feeds nobody
    beat.turn()
    assert messages(manager) == []  # nor does the head alone
    loop.run()
    assert messages(manager) == ["WATCHDOG=1"]
    beat.turn()
    loop.run()
    assert messages(manager) == []  # no more often than the manager requests
    now[0] = 2.1
    beat.turn()
    loop.run()
    assert messages(manager) == ["WATCHDOG=1"]


def test_a_loop_that_hangs_is_requested_once_and_sends_nothing(manager: socket.socket) -> None:
    now, loop = [0.0], Loop()
    beat = ServiceManager(environment(manager, WATCHDOG_USEC="1000000"), loop.soon, lambda: now[0])
    for _ in range(1000):
        now[0] += 0.02
        beat.turn()
    assert len(loop.waiting) == 1
    assert messages(manager) == []


# The same from a daemon in a process of its own

HEAD_THAT_ENDS_BADLY = OUTSIDE.replace(
    "    def read(self):\n",
    '    def read(self):\n        if os.path.exists("hang"):\n            time.sleep(600.0)\n'
    '        if os.path.exists("fail"):\n            raise OSError("the cable is out")\n',
)


@contextmanager
def watched_daemon(folder: Path, listener: socket.socket) -> Iterator[subprocess.Popen[str]]:
    """A daemon that a manager watches, once it has said that it is ready."""
    listener.settimeout(NET_S)
    environ = environment(listener, WATCHDOG_USEC="800000")
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environ.items():
            patch.setenv(name, value)
        config = write_config(folder, devices=HEAD_THAT_ENDS_BADLY)
        with daemon_process(folder, config, stderr=subprocess.DEVNULL) as daemon:
            while listener.recv(4096) != b"READY=1":
                pass
            yield daemon


def heard(listener: socket.socket, begins: str) -> str:
    """The next message that begins so."""
    while True:
        message = listener.recv(4096).decode()
        if message.startswith(begins):
            return message


def test_a_daemon_says_that_it_is_ready_that_it_lives_and_that_it_ends(
    manager: socket.socket, tmp_path: Path
) -> None:
    with watched_daemon(tmp_path, manager) as daemon:
        for _ in range(3):
            heard(manager, "WATCHDOG=1")
        daemon.send_signal(signal.SIGTERM)
        heard(manager, "STOPPING=1")
        assert daemon.wait(NET_S) == 0


def test_a_head_that_fails_is_alive_and_one_that_hangs_is_not(manager: socket.socket, tmp_path: Path) -> None:
    with watched_daemon(tmp_path, manager):
        (tmp_path / "fail").touch()
        for _ in range(10):
            heard(manager, "WATCHDOG=1")
        (tmp_path / "hang").touch()
        manager.settimeout(3.0)  # far more than the manager allows
        with pytest.raises(TimeoutError):
            for _ in range(100):
                manager.recv(4096)
