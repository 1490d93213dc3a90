"""The daemon's life: address, readiness, an orderly end whatever hangs, nothing left behind."""

from __future__ import annotations

import gc
import json
import os
import select
import signal
import socket
import stat
import subprocess
import tempfile
import threading
import time
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from calib.errors import BadFile
from calib.files.mast_file import save_rig
from drivers.errors import DriverError
from hil_tests import forks
from hil_tests.mastctl.outside_daemon import write_config as outside_config
from hil_tests.mastctl.service_fakes import (
    CONFIG,
    FakeHardware,
    Hang,
    ScriptedLoop,
    fake_daemon,
    rig,
)
from hil_tests.waiting import NET_S, joined, until
from mastctl.client import Client
from mastctl.config import Listen, load_config
from mastctl.control import operations as operations_module
from mastctl.daemon import AddressInUse, RunningDaemon, _suspend, _tcp_socket, run
from mastctl.devices import devices as devices_module
from mastctl.http.server import Server
from mastctl.safety.stop_threads import StopThreads
from mastctl.service import service as service_module

# A driver package from outside, for daemons in a process of their own: it writes what it is told to a file.
OUTSIDE = """
import os, time
from types import SimpleNamespace

import numpy as np


class Head:
    def __init__(self, log):
        self.log, self.pan, self.tilt = log, 0.0, 0.0

    def note(self, word):
        with open(self.log, "a") as log:
            log.write(word + "\\n")

    def read(self):
        angles = {"pan_rad": self.pan, "tilt_rad": self.tilt}
        return SimpleNamespace(**angles, moving=False, time_s=time.monotonic(), faults=[])

    def move(self, pan_rad, tilt_rad, speed_rad_per_s=None):
        self.note("move")
        self.pan, self.tilt = pan_rad, tilt_rad

    def stop(self):
        self.note("stop")

    def close(self):
        self.note("close")


class Camera:
    def next_frame(self, exposed_after_s, timeout_s):
        time.sleep(0.01)
        now = time.monotonic()
        self.count = getattr(self, "count", 0) + 1
        image = np.random.default_rng(self.count).integers(0, 255, (48, 64), dtype=np.uint8)
        return SimpleNamespace(image=image, sequence=self.count, mid_exposure_s=now - 0.002, exposure_s=0.002)

    def close(self):
        pass
"""


def write_config(folder: Path, listen: str) -> Path:
    return outside_config(folder, listen, OUTSIDE)


@contextmanager
def process(
    folder: Path, *words: str, popen: type[subprocess.Popen[str]] = forks.Popen
) -> Iterator[subprocess.Popen[str]]:
    """``mastctl`` in a process of its own."""
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    with (
        tempfile.TemporaryDirectory() as temporary,  # killed, it clears nothing away
        popen(
            [*forks.MASTCTL, *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment | {"TMPDIR": temporary},
            cwd=folder,
        ) as made,
    ):
        try:
            yield made
        finally:
            made.kill()


def first_line(made: subprocess.Popen[str]) -> str:
    """The first line of its stdout."""
    assert made.stdout is not None
    ready, _, _ = select.select([made.stdout], [], [], NET_S)
    assert ready, "no line came"
    return made.stdout.readline()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_daemon_cleanly_with_the_mast_stopped(
    tmp_path: Path, number: signal.Signals
) -> None:
    config = write_config(tmp_path, "{port: 0}")
    with process(tmp_path, "run", "--config", str(config), popen=subprocess.Popen) as daemon:
        url = first_line(daemon).removesuffix("\n")
        assert url.startswith("http://127.0.0.1:")
        with Client(url) as client:
            assert client.status()["state"] == "ready"
            operation = client.point(pan_rad=0.2, tilt_rad=0.1)
            assert client.wait(operation)["state"] == "done"
        daemon.send_signal(number)
        rest, log = daemon.communicate(timeout=NET_S)
        assert daemon.returncode == 0, log
    assert rest == ""
    assert "Traceback" not in log
    words = (tmp_path / "head.log").read_text().split()
    assert words[0] == "move"
    assert "stop" in words
    assert words[-1] == "close"


def test_a_signal_while_the_daemon_starts_ends_it_cleanly(tmp_path: Path) -> None:
    config = write_config(tmp_path, "{port: 0}")
    text = (tmp_path / "outside_devices.py").read_text()
    waiting = "print('opening', flush=True)\n        time.sleep(60)\n        self.log"
    (tmp_path / "outside_devices.py").write_text(text.replace("self.log", waiting, 1))
    with process(tmp_path, "run", "--config", str(config)) as daemon:
        assert first_line(daemon) == "opening\n"
        daemon.send_signal(signal.SIGTERM)
        _, log = daemon.communicate(timeout=NET_S)
    assert (daemon.returncode, log) == (0, "")


def test_a_signal_during_an_operation_stops_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    entered = threading.Event()

    def wait(request: Any, record: Any, cancelled: threading.Event, devices: Any) -> None:
        entered.set()
        assert cancelled.wait(NET_S)
        devices.move(0.3, 0.3)

    with fake_daemon(monkeypatch, tmp_path) as (daemon, hardware):
        monkeypatch.setattr(ScriptedLoop, "script", staticmethod(wait))
        with Client(daemon.url) as client:
            operation = client.point(pan_rad=0.1, tilt_rad=0.1)
        assert entered.wait(NET_S)
        daemon.close()
        record = daemon.service.operations.get(operation)
        assert record.state == "stopped"
        assert record.error is not None
        assert record.error["code"] == "stopped"
    assert {call[0] for call in hardware.head.calls} == {"stop"}
    assert hardware.closed == 1


def test_json_tells_the_address_as_a_document(tmp_path: Path) -> None:
    config = write_config(tmp_path, "{port: 0}")
    with process(tmp_path, "run", "--json", "--config", str(config)) as daemon:
        assert json.loads(first_line(daemon))["url"].startswith("http://127.0.0.1:")


def test_a_port_in_use_is_one_line_and_touches_no_hardware(tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        config = write_config(tmp_path, f"{{port: {port}}}")
        with process(tmp_path, "run", "--config", str(config)) as daemon:
            out, log = daemon.communicate(timeout=NET_S)
    assert daemon.returncode == 1
    assert out == ""
    assert log.splitlines()[-1].startswith(f"mastctl: http://127.0.0.1:{port} is in use already")
    assert "Traceback" not in log
    assert not (tmp_path / "head.log").exists()


def test_answers_do_not_wait_for_nagle() -> None:
    with _tcp_socket(Listen(port=0)) as listener:
        assert listener.proto == socket.IPPROTO_TCP  # by this asyncio knows to set TCP_NODELAY


def test_a_second_daemon_is_refused_the_address(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with fake_daemon(monkeypatch, tmp_path) as (daemon, _):
        port = daemon.url.rpartition(":")[2]
        (tmp_path / "daemon.yaml").write_text(CONFIG.format(listen=f"{{port: {port}}}"))
        with pytest.raises(AddressInUse):
            RunningDaemon(load_config(tmp_path / "daemon.yaml"))


def test_a_unix_socket_serves_its_owner_only_and_goes_with_the_daemon(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = tmp_path / "mast ctl.sock"
    listen = f"{{socket: '{path}'}}"
    with fake_daemon(monkeypatch, tmp_path, listen) as (daemon, _):
        assert daemon.url == f"unix:{tmp_path}/mast%20ctl.sock"
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        with Client(daemon.url) as client:
            assert client.status()["state"] == "ready"
            assert client.snapshot("navcam_left").image.shape == (48, 64)
        with pytest.raises(AddressInUse):
            RunningDaemon(load_config(tmp_path / "daemon.yaml"))
    assert not path.exists()


def test_a_socket_left_by_a_dead_daemon_is_replaced(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "left.sock"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    with (
        fake_daemon(monkeypatch, tmp_path, f"{{socket: '{path}'}}") as (daemon, _),
        Client(daemon.url) as client,
    ):
        assert client.status()["mast"]["name"] == "little"


def test_a_file_in_the_sockets_place_is_left_alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "precious"
    path.write_text("data")
    with pytest.raises(AddressInUse), fake_daemon(monkeypatch, tmp_path, f"{{socket: '{path}'}}"):
        pass
    assert path.read_text() == "data"


def test_a_daemon_leaves_no_thread_and_no_memory_behind(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    before = set(threading.enumerate())  # what other tests made hang is theirs
    with fake_daemon(monkeypatch, tmp_path) as (daemon, _):
        service, made = weakref.ref(daemon.service), weakref.ref(daemon)
        before_others = {thread for thread in threading.enumerate() if thread.name.startswith("AnyIO")}
        with Client(daemon.url) as client:
            client.wait(client.point(pan_rad=0.1, tilt_rad=0.1))
            client.snapshot("navcam_left")
            client.stop()
    ours = ("device", "operation", "stop", "daemon", "closing")
    until(
        lambda: not [t for t in set(threading.enumerate()) - before if t.name.startswith(ours)],
        "our threads gone",
    )
    until(
        lambda: {t for t in threading.enumerate() if t.name.startswith("AnyIO")} <= before_others,
        "the web server's threads gone",
    )
    del daemon
    gc.collect()
    assert service() is None and made() is None


def test_the_end_is_bounded_although_everything_hangs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(operations_module, "END_TIMEOUT_S", 0.2)
    monkeypatch.setattr(service_module, "HARDWARE_CLOSE_S", 0.2)
    hang = Hang()
    with fake_daemon(monkeypatch, tmp_path) as (daemon, hardware):
        monkeypatch.setattr(devices_module, "STOP_TIMEOUT_S", 0.2)
        monkeypatch.setattr(ScriptedLoop, "script", staticmethod(lambda *any: hang()))
        with Client(daemon.url) as client:
            operation = client.point(pan_rad=0.1, tilt_rad=0.1)
        monkeypatch.setattr(hardware, "close", hang)
        hardware.head.hook = hang
        for camera in hardware.fake_cameras.values():
            camera.hook = hang
        daemon.close()
        assert daemon.service.operations.get(operation).state == "stopped"
    for words in ("did not confirm", "is given up", "is left behind"):
        assert words in caplog.text
    hang.let_go()


def test_a_daemon_whose_server_fails_as_it_starts_is_never_told_ready(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    hardware = FakeHardware()
    save_rig(rig(), tmp_path / "little.yaml")
    path = tmp_path / "daemon.yaml"
    path.write_text(CONFIG.format(listen="{port: 0}"))
    monkeypatch.setattr("mastctl.devices.opening.open_hardware", lambda settings, clock: hardware)

    async def fails(self: object, sockets: object = None) -> None:
        raise OSError("no room for a server")

    monkeypatch.setattr(Server, "serve", fails)
    told: list[str] = []
    with (
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager,
        monkeypatch.context() as patch,
        pytest.raises(OSError, match="no room for a server"),
    ):
        manager.bind(str(tmp_path / "notify"))
        manager.setblocking(False)
        patch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        try:
            run(load_config(path), told.append)
        finally:
            with suppress(BlockingIOError):
                while True:
                    told.append(manager.recv(1000).decode())
    assert [one for one in told if "READY=1" in one or one.startswith("http")] == []
    assert hardware.closed


@pytest.mark.parametrize("stopped", [True, False])
def test_a_daemon_is_suspended_only_once_the_mast_was_stopped(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, stopped: bool
) -> None:
    signals: list[int] = []
    monkeypatch.setattr("mastctl.daemon.os.kill", lambda process, number: signals.append(number))

    def stop() -> None:
        if not stopped:
            raise DriverError("the head did not confirm the stop", device="pan_tilt")

    threads = StopThreads()
    service = SimpleNamespace(stop_threads=threads, stopping=SimpleNamespace(stop=stop))
    _suspend(service)  # type: ignore[arg-type]
    until(lambda: signals or caplog.records, "what came of it")
    threads.close()
    assert signals == ([signal.SIGSTOP] if stopped else [])
    if not stopped:
        assert "not suspended: the stop failed and the head may still move" in caplog.text
        assert "the head did not confirm the stop" in caplog.text


def test_a_part_that_cannot_be_closed_keeps_no_other_open(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with fake_daemon(monkeypatch, tmp_path) as (daemon, hardware):
        service, closed = daemon.service, list[str]()
        named = ("guide", "metrics", "stop_threads", "recording", "audit", "latch", "folder")
        for name in named:
            part = getattr(service, name)

            def close(name: str = name, close: Any = part.close) -> None:
                closed.append(name)
                close()
                if name in ("guide", "recording"):
                    raise RuntimeError(f"a defect of {name}")

            monkeypatch.setattr(part, "close", close)
        daemon.close()
        assert closed == list(named) and hardware.closed
    assert "a defect of guide" in caplog.text and "a defect of recording" in caplog.text


def test_what_keeps_a_daemon_from_starting_is_typed_and_leaves_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    before = set(threading.enumerate())

    def fail(settings: Any, clock: Any) -> Any:
        raise DriverError("no head on the bus", device="pan_tilt")

    hardware = FakeHardware()
    save_rig(rig(), tmp_path / "little.yaml")
    path = tmp_path / "daemon.yaml"
    path.write_text(CONFIG.format(listen="{port: 0}"))
    monkeypatch.setattr("mastctl.devices.opening.open_hardware", fail)
    with pytest.raises(DriverError, match="no head on the bus"):
        RunningDaemon(load_config(path))
    monkeypatch.setattr("mastctl.devices.opening.open_hardware", lambda settings, clock: hardware)
    path.write_text(path.read_text().replace("navcam_left:", "navcam_lift:"))
    with pytest.raises(BadFile, match="navcam_lift"):
        RunningDaemon(load_config(path))
    path.write_text(path.read_text().replace("little.yaml", "missing.yaml"))
    with pytest.raises(BadFile, match=r"missing\.yaml"):
        RunningDaemon(load_config(path))
    assert set(threading.enumerate()) <= before


def test_many_clients_at_once_get_one_operation_at_a_time(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from mastctl.client import ClientError

    running: list[int] = []
    most: list[int] = []

    def count(request: Any, record: Any, cancelled: Any, devices: Any) -> None:
        running.append(1)
        most.append(len(running))
        time.sleep(0.02)
        running.pop()

    answers: list[str] = []
    with fake_daemon(monkeypatch, tmp_path) as (daemon, _):
        monkeypatch.setattr(ScriptedLoop, "script", staticmethod(count))

        def ask() -> None:
            with Client(daemon.url) as client:
                for _ in range(10):
                    try:
                        answers.append(client.wait(client.point(pan_rad=0.1, tilt_rad=0.1))["state"])
                    except ClientError as error:
                        answers.append(error.code)

        askers = [threading.Thread(target=ask) for _ in range(6)]
        for asker in askers:
            asker.start()
        joined(*askers)
        done = [record for record in daemon.service.operations.all() if record.state == "done"]
    assert set(answers) == {"done", "busy"}
    assert len(answers) == 60
    assert answers.count("done") == len(done)
    assert set(most) == {1}
