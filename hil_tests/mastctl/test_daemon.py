"""The daemon's life: address, readiness, an orderly end whatever hangs, nothing left behind."""

from __future__ import annotations

import gc
import signal
import socket
import stat
import threading
import weakref
from pathlib import Path
from typing import Any

import pytest

from hil_tests.mastctl.outside_daemon import daemon_process, line, write_config
from hil_tests.mastctl.service_fakes import (
    Hang,
    ScriptedLoop,
    fake_daemon,
)
from hil_tests.waiting import NET_S, until
from mastctl.client import Client
from mastctl.config import load_config
from mastctl.control import operations as operations_module
from mastctl.daemon import AddressInUse, RunningDaemon
from mastctl.devices import devices as devices_module
from mastctl.service import service as service_module


def test_a_signal_while_the_daemon_starts_ends_it_cleanly(tmp_path: Path) -> None:
    config = write_config(tmp_path)
    text = (tmp_path / "outside_devices.py").read_text()
    waiting = "print('opening', flush=True)\n        time.sleep(60)\n        self.log"
    (tmp_path / "outside_devices.py").write_text(text.replace("self.log", waiting, 1))
    with daemon_process(tmp_path, config) as daemon:
        assert line(daemon) == "opening"
        daemon.send_signal(signal.SIGTERM)
        _, log = daemon.communicate(timeout=NET_S)
    assert (daemon.returncode, log) == (0, "")


def test_a_port_in_use_is_one_line_and_touches_no_hardware(tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        config = write_config(tmp_path, f"{{port: {port}}}")
        with daemon_process(tmp_path, config) as daemon:
            out, log = daemon.communicate(timeout=NET_S)
    assert daemon.returncode == 1
    assert out == ""
    assert log.splitlines()[-1].startswith(f"mastctl: http://127.0.0.1:{port} is in use already")
    assert "Traceback" not in log
    assert not (tmp_path / "head.log").exists()


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
    for sentence in ("did not confirm", "is given up", "is left behind"):
        assert sentence in caplog.text
    hang.let_go()


def test_a_part_that_cannot_be_closed_keeps_no_other_open(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with fake_daemon(monkeypatch, tmp_path) as (daemon, hardware):
        service, closed = daemon.service, list[str]()
        named = ("bench", "metrics", "recorder", "stop_threads", "journals", "latch", "folder")
        for name in named:
            part = getattr(service, name)

            def close(name: str = name, close: Any = part.close) -> None:
                closed.append(name)
                close()
                if name in ("bench", "recorder"):
                    raise RuntimeError(f"a defect of {name}")

            monkeypatch.setattr(part, "close", close)
        daemon.close()
        assert closed == list(named) and hardware.closed
    assert "a defect of bench" in caplog.text and "a defect of recorder" in caplog.text
