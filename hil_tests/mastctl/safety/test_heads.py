"""The latch belongs to the head: whatever leads to its line finds it, and it logs its causes."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from drivers.hardware import DeviceSettings, HardwareSettings, head_name
from drivers.serial_line import stable_name
from hil_tests import forks
from hil_tests.mastctl.outside_daemon import free_port, line
from hil_tests.mastctl.safety.test_deaths import Bench, made
from hil_tests.waiting import NET_S, present
from mastctl.client import Client, ClientError
from mastctl.errors import NotNow
from mastctl.safety import state_folder as state_folder_module
from mastctl.safety.latch import Latch
from mastctl.safety.state_folder import StateFolder, StateInUse, head_folders


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    """A real driver on a line of its own, with nothing said of where state is kept."""
    with made("dynamixel", tmp_path) as one:
        document = json.loads(one.config.read_text())
        del document["state"]
        one.config.write_text(json.dumps(document))
        yield one


@contextlib.contextmanager
def running(config: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    """A daemon in a process of its own."""
    with (
        tempfile.TemporaryDirectory() as temporary,
        forks.Popen(
            [*forks.MASTCTL, "run", "--config", str(config), *options],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            env={**os.environ, "TMPDIR": temporary}, cwd=config.parent,
        ) as daemon,
    ):  # fmt: skip
        try:
            yield daemon
        finally:
            daemon.kill()


def killed_while_latched(bench: Bench) -> None:
    """A daemon that answered that its emergency stop is kept, and was killed."""
    with running(bench.config) as daemon, Client(line(daemon)) as client:
        assert client.estop(reason="sparks", name="Ana")["kept"] is True


@pytest.mark.parametrize("way", ["any port", "copy"])
def test_the_next_daemon_of_the_head_is_latched_whatever_way_it_begins(
    bench: Bench, tmp_path: Path, way: str
) -> None:
    killed_while_latched(bench)
    config, options = bench.config, ["--listen", "127.0.0.1:0"]
    if way == "copy":
        config = tmp_path / "copy.yaml"
        document = json.loads(bench.config.read_text()) | {"state": {"folder": "elsewhere"}}
        config.write_text(json.dumps(document))
        options = []
    with running(config, *options) as daemon, Client(line(daemon)) as client:
        status = client.status()
        assert (status["state"], status["estop"] and present(status["estop"])["name"]) == ("stopped", "Ana")
        with pytest.raises(ClientError, match="latched"):
            client.point(pan_rad=0.1, tilt_rad=0.0)
        client.reset(reason="looked", name="Ben")
    with running(bench.config) as daemon, Client(line(daemon)) as client:
        assert client.status()["estop"] is None


def test_a_stop_finds_a_daemon_of_its_configuration_that_listens_elsewhere(bench: Bench) -> None:
    elsewhere = f"127.0.0.1:{free_port()}"
    with running(bench.config, "--listen", elsewhere) as daemon, Client(line(daemon)) as client:
        command = [*forks.MASTCTL, "estop", "--config", str(bench.config), "--name", "Ana"]
        done = forks.run(command, timeout=NET_S)
        assert done.returncode == 0, done.stderr
        assert present(client.status()["estop"])["name"] == "Ana"


# The log of causes


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[StateFolder]:
    made_folder = StateFolder(tmp_path)
    yield made_folder
    made_folder.close()


def test_a_latch_logs_its_causes_and_a_reset_releases_all(folder: StateFolder) -> None:
    latch = Latch(folder)
    latch.add("smoke", "Ana")
    latch.add("a hand in the way", "Ben")
    latch.add("smoke", "Ana")  # once in the log
    latch.add("sparks", "Ana")
    for number in range(10):
        latch.add("a stranger", f"client {number}")
    assert latch.keep(NET_S)
    causes = [("Ana", "smoke"), ("Ben", "a hand in the way"), ("Ana", "sparks")]
    causes += [(f"client {number}", "a stranger") for number in range(2)]
    assert [(one.name, one.reason) for one in Latch(folder).entries] == causes
    assert [(one.name, one.reason) for one in latch.release("aired", "Cem")] == causes
    assert not latch.entries and Latch(folder).entries == ()
    with pytest.raises(NotNow, match="no emergency stop"):
        latch.release("aired", "Cem")


# Which head


def test_a_line_has_one_name_whatever_path_leads_to_it(tmp_path: Path) -> None:
    primary, secondary = os.openpty()
    try:
        path = os.ttyname(secondary)
        (tmp_path / "mast").symlink_to(path)
        assert stable_name(str(tmp_path / "mast")) == stable_name(path)
    finally:
        os.close(primary)
        os.close(secondary)
    assert stable_name("socket://LOCALHOST:4001") == stable_name("socket://127.0.0.1:4001")
    assert stable_name("socket://127.0.0.1:4001") != stable_name("socket://127.0.0.1:4002")
    assert stable_name("socket://[::1:4001") == "socket://[::1:4001", "its opening refuses it"


def test_an_adapter_is_known_by_its_serial_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from drivers import serial_line

    (tmp_path / "ttyUSB0").write_text("")
    (tmp_path / "by-id").mkdir()
    (tmp_path / "by-id" / "usb-FTDI_A6008isP-if00-port0").symlink_to(tmp_path / "ttyUSB0")
    monkeypatch.setattr(serial_line, "BY_ID", tmp_path / "by-id")
    name = stable_name(str(tmp_path / "ttyUSB0"))
    assert name == stable_name(str(tmp_path / "by-id" / "usb-FTDI_A6008isP-if00-port0"))
    (tmp_path / "by-id" / "usb-FTDI_A6008isP-if00-port0").unlink()
    (tmp_path / "ttyUSB0").rename(tmp_path / "ttyUSB1")
    (tmp_path / "by-id" / "usb-FTDI_A6008isP-if00-port0").symlink_to(tmp_path / "ttyUSB1")
    assert stable_name(str(tmp_path / "ttyUSB1")) == name


def test_a_head_in_this_programs_memory_is_nobody_elses() -> None:
    settings = HardwareSettings(DeviceSettings("sim"), {})
    assert head_name(settings) is None
    assert head_name(replace(settings, pan_tilt=DeviceSettings("replay"))) is None
    outside = DeviceSettings("drivers.flir_ptu.head:FlirPtu", {"port": "socket://10.0.0.1:4001", "speed": 1})
    slow = DeviceSettings("drivers.flir_ptu.head:FlirPtu", {"port": "socket://10.0.0.1:4001", "speed": 2})
    one, other = (head_name(replace(settings, pan_tilt=head)) for head in (outside, slow))
    assert one == other and one is not None
    assert head_name(replace(settings, pan_tilt=DeviceSettings("dynamixel", {"address": 7}))), "its options"


def test_a_true_line_has_its_place_by_no_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only lines of simulators follow $MASTCTL_HEADS, so that tests share nothing."""
    monkeypatch.setattr(state_folder_module, "SYSTEM", tmp_path / "no_such")
    monkeypatch.setattr(state_folder_module, "_home", lambda: tmp_path / "home")
    places = []
    for folder in ("one", "two"):
        for name in ("MASTCTL_HEADS", "HOME", "XDG_STATE_HOME", "STATE_DIRECTORY", "TMPDIR"):
            monkeypatch.setenv(name, str(tmp_path / folder))
        places.append(head_folders("usb-FTDI_A6008isP-if00-port0"))
        places.append(head_folders("10.0.0.5:4001"))
    assert places[:2] == places[2:]
    assert all(one[0].is_relative_to(tmp_path / "home") for one in places)
    for name in ("127.0.0.1", "127.0.0.1:4001", "[::1]", "[::1]:4001"):
        assert [one.parent for one in head_folders(name)] == [tmp_path / "two"], name


def test_a_latch_in_the_systems_or_in_the_users_place_blocks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(state_folder_module, "SYSTEM", tmp_path / "system")
    monkeypatch.setattr(state_folder_module, "_home", lambda: tmp_path / "home")
    name = "usb-FTDI_A6008isP-if00-port0"
    with contextlib.closing(present(state_folder_module.take_head(name))) as place:
        latch = Latch(place)
        latch.add("smoke", "Ana")
        assert latch.keep(NET_S)
        latch.close()
        assert place.path.is_relative_to(tmp_path / "home")
    (tmp_path / "system").mkdir()
    with contextlib.closing(present(state_folder_module.take_head(name))) as place:
        assert place.path.is_relative_to(tmp_path / "system")
        latch = Latch(place, others=head_folders(name))
        assert latch.entries[0].name == "Ana"
        latch.release("aired", "Ben")
    shutil.rmtree(tmp_path / "system")
    with contextlib.closing(present(state_folder_module.take_head(name))) as place:
        assert not Latch(place).entries


def test_one_head_is_one_programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state_folder_module, "SYSTEM", tmp_path / "no_such")
    monkeypatch.setattr(state_folder_module, "_home", lambda: tmp_path / "home")
    with (
        contextlib.closing(present(state_folder_module.take_head("usb-1"))),
        pytest.raises(StateInUse, match="the head at usb-1 is driven by another program"),
    ):
        state_folder_module.take_head("usb-1")
