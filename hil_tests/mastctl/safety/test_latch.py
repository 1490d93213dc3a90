"""The emergency stop: latched at once, kept across restarts, released by a reason and a name only."""

from __future__ import annotations

import contextlib
import json
import random
import socket
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest

from calib.errors import BadFile
from drivers.errors import DriverError
from hil_tests.mastctl.outside_daemon import daemon_process, line, write_config
from hil_tests.mastctl.service_fakes import CONFIG, Hang, ScriptedLoop, fake_daemon
from hil_tests.waiting import NET_S, present, until
from mastctl.client import Client, ClientError
from mastctl.control.machine import Latched
from mastctl.errors import NotNow, Stopped, Unable
from mastctl.safety import latch as latch_module
from mastctl.safety.latch import FILE, Estopped, Latch, latched_at
from mastctl.safety.state_folder import StateFile, StateFolder, usual_folder
from mastctl.service import stopping as stopping_module

SECTOR_BYTES = 512
KEPT = CONFIG + "state: {{folder: state}}\n"


@pytest.fixture
def folder(tmp_path: Path) -> Any:
    path = tmp_path / "state"
    path.mkdir()
    made = StateFolder(path)
    yield made
    made.close()


# The latch by itself


def latched(folder: StateFolder) -> Latch:
    """A latch with a stop that the disk holds."""
    latch = Latch(folder)
    latch.add("smoke", "Ana")
    assert latch.keep(NET_S)
    return latch


def test_a_latched_stop_is_found_by_the_next_daemon(folder: StateFolder) -> None:
    latch = Latch(folder)
    assert not latch.entries
    cause = latch.add("sparks at the\nmast", "Ana")
    assert latch.keep(NET_S)
    assert (cause.reason, cause.name) == ("sparks at the mast", "Ana")
    assert Latch(folder).entries[0] == cause


@pytest.mark.parametrize("data", [b"", b"\0" * 300, b'{"schema": "mastctl/latch/1"}'])
def test_a_latch_file_that_cannot_be_read_means_latched(folder: StateFolder, data: bytes) -> None:
    (folder.path / FILE).write_bytes(data)
    latch = Latch(folder)
    assert latch.entries
    latch.release("looked at it", "Ben")
    assert not Latch(folder).entries


def test_a_latch_that_no_disk_takes_is_in_memory_and_a_fault(
    folder: StateFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(latch_module, "AGAIN_S", 0.01)
    full = threading.Event()
    full.set()
    true = StateFile.overwrite

    def overwrite(file: StateFile, document: Any) -> None:
        if full.is_set():
            refuse(file)
        true(file, document)

    monkeypatch.setattr(StateFile, "overwrite", overwrite)
    latch = Latch(folder)
    cause = latch.add("smoke", "Ana")
    assert not latch.keep(NET_S)
    assert latch.entries[0] == cause
    assert "No space left" in latch.not_kept
    full.clear()
    until(lambda: latch.not_kept == "", "the disk takes it")
    assert Latch(folder).entries[0] == cause


def refuse(file: StateFile, *ignored: Any) -> None:
    raise BadFile(file.path, "", "cannot be saved: No space left on device")


def test_a_reset_that_the_disk_refuses_releases_nothing(
    folder: StateFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    latch = latched(folder)
    with monkeypatch.context() as patch:
        for method in ("write", "overwrite"):
            patch.setattr(StateFile, method, refuse)
        for _ in range(3):
            with pytest.raises(Unable, match=r"stays latched.*No space"):
                latch.release("aired", "Ben")
            assert latch.entries
    assert Latch(folder).entries == latch.entries
    latch.release("aired", "Ben")
    assert not Latch(folder).entries


def test_a_stop_during_a_reset_wins(folder: StateFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    latch = latched(folder)
    true = StateFile.overwrite

    def overwrite(file: StateFile, document: Any) -> None:
        monkeypatch.setattr(StateFile, "overwrite", true)
        true(file, document)
        latch.add("more smoke", "Cem")

    monkeypatch.setattr(StateFile, "overwrite", overwrite)
    with pytest.raises(NotNow, match="another emergency stop"):
        latch.release("aired", "Ben")
    assert latch.entries
    until(lambda: Latch(folder).entries == latch.entries, "the disk holds it again")


@pytest.mark.parametrize("reason", ["smoke", "\U0001f525" * 200])
def test_a_power_cut_while_a_latch_is_written_reads_as_latched(folder: StateFolder, reason: str) -> None:
    latch, path = Latch(folder), folder.path / FILE
    latch.add("sparks", "Ana")
    assert latch.keep(NET_S)
    latch.release("\U0001f525" * 200, "Ben")
    old = path.read_bytes()
    latch.add(reason, "Cem")
    assert latch.keep(NET_S)
    new = path.read_bytes()
    assert len(new) == len(old)
    parts = [slice(at, at + SECTOR_BYTES) for at in range(0, len(new), SECTOR_BYTES)]
    chance = random.Random(1)
    for _ in range(100):
        mixed = [new[parts[0]], *(chance.choice((old, new))[part] for part in parts[1:])]
        path.write_bytes(b"".join(mixed))
        assert Latch(folder).entries
    path.write_bytes(b"".join([old[parts[0]], *(new[part] for part in parts[1:])]))
    Latch(folder)  # before its first sector nothing was confirmed; it starts


# The folder


def test_the_usual_place_is_of_configuration_and_address(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    config = tmp_path / "rover.yaml"
    places = {usual_folder(config, url) for url in ("http://127.0.0.1:1", "http://127.0.0.1:2")}
    places.add(usual_folder(tmp_path / "other" / "rover.yaml", "http://127.0.0.1:1"))
    assert len(places) == 3
    assert all(place.parent == tmp_path / "mastctl" and place.name.startswith("rover-") for place in places)
    made = StateFolder.of(None, config, "http://127.0.0.1:1")
    assert made.path in places
    assert made.path.stat().st_mode & 0o777 == 0o700
    made.close()


def test_systemd_names_the_folder_and_the_configuration_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", f"{tmp_path / 'one'}:{tmp_path / 'two'}")
    for named, expected in ((None, tmp_path / "one"), (tmp_path / "named", tmp_path / "named")):
        made = StateFolder.of(named, tmp_path / "rover.yaml", "http://127.0.0.1:1")
        assert made.path == expected
        made.close()


def test_a_state_folder_that_cannot_be_made_refuses_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    for named in (None, tmp_path / "file" / "in"):
        with pytest.raises(BadFile, match=r"cannot be made: Not a directory; name another.*state\.folder"):
            StateFolder.of(named, tmp_path / "rover.yaml", "http://127.0.0.1:1")


# The daemon


def test_after_an_emergency_stop_nothing_moves_whatever_way_it_comes(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with fake_daemon(monkeypatch, tmp_path, config=KEPT) as (daemon, hardware), Client(daemon.url) as client:
        outcome = client.estop(reason="sparks", name="Ana")
        assert (outcome["stopped"], outcome["latched"], outcome["kept"]) == (True, True, True)
        assert ("stop",) in hardware.head.calls  # once more where the head was late to confirm it
        status = client.status()
        assert (status["state"], present(status["estop"])["name"]) == ("stopped", "Ana")
        for ask in (
            lambda: client.point(pan_rad=0.1, tilt_rad=0.1),
            lambda: client.start_track(position_m=(6.0, 0.0, 0.0)),
            client.look,
        ):
            with pytest.raises(ClientError, match=r"latched \(Ana: sparks\).*mastctl reset") as refused:
                ask()
            assert refused.value.code == "estopped"
        with pytest.raises(Estopped):
            daemon.service.devices.move(0.1, 0.1)
        client.stop()  # takes nothing back
        with pytest.raises(Estopped):
            daemon.service.devices.move(0.1, 0.1)
        assert not [call for call in hardware.head.calls if call[0] == "move"]
        assert client.reset(reason="a loose wire, tied", name="Ben")["released"]["reason"] == "sparks"
        assert not [call for call in hardware.head.calls if call[0] == "move"]
        assert client.status()["estop"] is None
        client.wait(client.point(pan_rad=0.1, tilt_rad=0.1))
        assert [call for call in hardware.head.calls if call[0] == "move"]


@pytest.mark.parametrize(
    ("body", "kind", "reason"),
    [
        (b"", "", "no reason given"),
        (b'{"reason": 3}', "text/plain", "no reason given"),
        (b'{"reason": "x", "reason": "y", "more": NaN}', "application/json", "y"),
        (b'{"reason": "a \\ud800 b"}', "application/json", "a ? b"),
        (b'{"reason": "' + b"x" * 300 + b'"}', "application/json", "x" * 200),
    ],
)
def test_an_emergency_stop_is_never_refused_for_its_words(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, body: bytes, kind: str, reason: str
) -> None:
    with fake_daemon(monkeypatch, tmp_path) as (daemon, hardware):
        headers = {"content-type": kind} if kind else {}
        answer = httpx.post(f"{daemon.url}/api/v1/estop", content=body, headers=headers, timeout=NET_S)
        assert (answer.status_code, answer.json()["reason"]) == (200, reason)
        status = httpx.get(f"{daemon.url}/api/v1/status", timeout=NET_S)
        assert present(status.json()["estop"])["reason"] == reason
        assert ("stop",) in hardware.head.calls


def until_stopped(request: Any, record: Any, cancelled: threading.Event, devices: Any) -> None:
    """An operation that nothing but a stop ends."""
    cancelled.wait(NET_S)
    raise Stopped("it was stopped")


def test_an_emergency_stop_does_not_wait_for_a_reason_that_does_not_come(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with fake_daemon(monkeypatch, tmp_path, config=KEPT) as (daemon, hardware), Client(daemon.url) as client:
        with monkeypatch.context() as patch:
            patch.setattr(ScriptedLoop, "script", staticmethod(until_stopped))
            operation = client.point(pan_rad=0.1, tilt_rad=0.1)
            until(lambda: client.operation(operation)["state"] == "running", "the operation")
        address = urlsplit(daemon.url)
        with socket.create_connection((address.hostname, address.port), timeout=NET_S) as line:
            head = f"POST /api/v1/estop HTTP/1.1\r\nHost: {address.netloc}\r\nConnection: close\r\n"
            line.sendall(f"{head}Content-Length: 20\r\n\r\n".encode())
            answer = b"".join(iter(partial(line.recv, 65536), b""))
        stopped = json.loads(answer.partition(b"\r\n\r\n")[2])
        assert (stopped["latched"], stopped["kept"], stopped["reason"]) == (True, True, "no reason given")
        assert ("stop",) in hardware.head.calls
        assert "emergency stop" in present(client.wait(operation)["error"])["message"]
        with pytest.raises(Estopped):
            daemon.service.devices.move(0.1, 0.1)
        client.estop(reason="a hand", name="Ana")
        assert [cause["reason"] for cause in client.status()["estops"]] == ["no reason given", "a hand"]
        client.reset(reason="the hand is away", name="Ana")
        client.wait(client.point(pan_rad=0.1, tilt_rad=0.1))


@pytest.mark.parametrize(
    "body",
    [{"reason": "x"}, {"name": "x"}, {"reason": " ", "name": "x"}],
)
def test_a_reset_needs_a_reason_and_a_name(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, body: dict[str, str]
) -> None:
    with fake_daemon(monkeypatch, tmp_path) as (daemon, _), Client(daemon.url) as client:
        client.estop()
        answer = httpx.post(f"{daemon.url}/api/v1/reset", json=body, timeout=NET_S)
        assert (answer.status_code, present(answer.json()["error"])["code"]) == (422, "bad_request")
        assert daemon.service.latch.entries


def test_a_reset_waits_for_a_stop_that_is_under_way(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    hang = Hang()
    with fake_daemon(monkeypatch, tmp_path) as (daemon, hardware), Client(daemon.url) as client:
        client.estop()
        with monkeypatch.context() as patch:
            patch.setattr(hardware.head, "stop", hang)
            stopping = threading.Thread(target=stop, args=(daemon.url,))
            stopping.start()
            until(lambda: not daemon.service.devices.stops_returned(0.0), "the stop")
            with pytest.raises(ClientError, match="being stopped") as refused:
                client.reset(reason="x", name="y")
            assert refused.value.code == "stopping"
            hang.let_go()
            stopping.join(NET_S)
        until(lambda: not daemon.service.machine.standing.stops, "the stop's end")
        client.reset(reason="x", name="y")


def test_an_emergency_stop_in_the_middle_of_a_reset_is_latched_everywhere(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with fake_daemon(monkeypatch, tmp_path, config=KEPT) as (daemon, _), Client(daemon.url) as client:
        service = daemon.service
        client.estop(reason="sparks", name="Ana")
        true = service.latch.release

        def release(reason: str, name: str) -> tuple[Latched, ...]:
            causes = true(reason, name)
            service.stopping.latch_estop("smoke", "Cem")
            return causes

        with monkeypatch.context() as patch:
            patch.setattr(service.latch, "release", release)
            client.reset(reason="looked", name="Ben")
        status = client.status()
        assert (status["state"], present(status["estop"])["name"]) == ("stopped", "Cem")
        with pytest.raises(Estopped, match="smoke"):
            service.devices.move(0.1, 0.1)
        assert client.reset(reason="looked", name="Ben")["released"]["name"] == "Cem"
        client.wait(client.point(pan_rad=0.1, tilt_rad=0.1))


def stop(url: str) -> None:
    with contextlib.suppress(ClientError), Client(url) as client:
        client.stop()


def test_an_unconfirmed_emergency_stop_is_latched_all_the_same(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def refuse() -> None:
        raise DriverError("the cable is cut")

    with fake_daemon(monkeypatch, tmp_path, config=KEPT) as (daemon, hardware), Client(daemon.url) as client:
        with monkeypatch.context() as patch:
            patch.setattr(hardware.head, "stop", refuse)
            with pytest.raises(ClientError, match=r"latched, but the head did not confirm.*cable") as outcome:
                client.estop(name="Ana")
            assert outcome.value.code == "stop_unconfirmed"
        assert present(client.status()["estop"])["name"] == "Ana"
        assert (tmp_path / "state" / FILE).exists()


def test_a_disk_that_hangs_delays_an_emergency_stop_by_little(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    hang = Hang()
    with fake_daemon(monkeypatch, tmp_path, config=KEPT) as (daemon, hardware), Client(daemon.url) as client:
        for way in ("write", "overwrite"):
            monkeypatch.setattr(StateFile, way, hang)
        monkeypatch.setattr(stopping_module, "KEPT_S", 0.05)
        outcome = client.estop()
        assert (outcome["latched"], outcome["kept"]) == (True, False)
        assert "would not survive" in present(outcome["message"])
        assert ("stop",) in hardware.head.calls
        (fault,) = client.status()["faults"]
        assert (fault["device"], fault["code"]) == ("state", "latch_not_kept")
        monkeypatch.undo()
        hang.let_go()


# A daemon in a process of its own


def test_a_second_daemon_of_one_state_folder_does_not_touch_the_head(tmp_path: Path) -> None:
    config = write_config(tmp_path)
    config.write_text(config.read_text() + "state: {folder: state}\n")
    with daemon_process(tmp_path, config) as daemon:
        line(daemon)
        with daemon_process(tmp_path, config) as second:
            _, sentence = second.communicate(timeout=NET_S)
        assert second.returncode == 1
        assert "is in use by another daemon" in sentence.splitlines()[-1]
        assert "Traceback" not in sentence


LATCHES_AND_RELEASES = """
import sys
from pathlib import Path
from mastctl.safety.latch import Latch
from mastctl.safety.state_folder import StateFolder

latch = Latch(StateFolder(Path(sys.argv[1])))
while True:
    latch.add("smoke", "Ana")
    assert latch.keep(60.0)
    print("kept", flush=True)
    sys.stdin.readline()
    latch.release("aired", "Ben")
    print("released", flush=True)
    sys.stdin.readline()
"""


@pytest.mark.long(1, "100 programs are started and killed")
def test_a_kill_at_any_moment_leaves_what_was_confirmed_last(tmp_path: Path) -> None:
    chance = random.Random(1)
    command = [sys.executable, "-c", LATCHES_AND_RELEASES, str(tmp_path)]
    for number in range(100):
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        ) as program:
            assert program.stdin is not None and program.stdout is not None
            assert program.stdout.readline() == "kept\n"
            if released := bool(number % 3):
                program.stdin.write("\n")
                program.stdin.flush()
                time.sleep(chance.uniform(0.0, 0.004))
            program.kill()
            confirmed = "released" in program.stdout.read()
        if confirmed or not released:
            assert bool(latched_at([tmp_path])) is not confirmed, f"kill {number}"
