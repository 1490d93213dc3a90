"""The emergency stop: latched at once, kept across restarts, released by a reason and a name only."""

from __future__ import annotations

import contextlib
import errno
import os
import random
import shutil
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import pytest

from calib.errors import BadFile
from drivers.errors import DriverError
from hil_tests.mastctl.outside_daemon import daemon_process, free_port, line, under_way, write_config
from hil_tests.mastctl.service_fakes import CONFIG, Hang, ScriptedLoop, fake_daemon
from hil_tests.waiting import NET_S, until
from mastctl.client import Client, ClientError
from mastctl.control import machine as machine_module
from mastctl.control.standing import Latched
from mastctl.errors import NotNow, Unable
from mastctl.safety import latch as latch_module
from mastctl.safety import stop_threads
from mastctl.safety.latch import FILE, Estopped, Latch
from mastctl.safety.state_file import StateFile
from mastctl.safety.state_folder import StateFolder, StateInUse, usual_folder
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
    latch.hold("smoke", "Ana")
    latch.head_told()
    assert latch.kept_within(NET_S)
    return latch


def test_a_latched_stop_is_found_by_the_next_daemon(folder: StateFolder) -> None:
    latch = Latch(folder)
    assert latch.held is None
    held = latch.hold("sparks at the\nmast", "Ana")
    latch.head_told()
    assert latch.kept_within(NET_S)
    assert (held.reason, held.name) == ("sparks at the mast", "Ana")
    assert Latch(folder).held == held


def test_the_disk_waits_for_the_head_but_not_for_long(
    folder: StateFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(latch_module, "HEAD_FIRST_S", 1e6)
    latch = Latch(folder)
    latch.hold(None, None)
    assert not latch.kept_within(0.05)
    assert "not confirmed" in latch.not_kept
    latch.head_told()
    assert latch.kept_within(NET_S)
    monkeypatch.setattr(latch_module, "HEAD_FIRST_S", 0.05)
    latch.release("looked", "Ben")
    latch.hold(None, None)
    assert latch.kept_within(NET_S)  # a head that hangs does not keep the disk


@pytest.mark.parametrize("data", [b"", b"{}", b"\0" * 300, b'{"schema": "mastctl/latch/1"}', b"[]"])
def test_a_latch_file_that_cannot_be_read_means_latched(folder: StateFolder, data: bytes) -> None:
    (folder.path / FILE).write_bytes(data)
    latch = Latch(folder)
    assert latch.held is not None
    latch.release("looked at it", "Ben")
    assert Latch(folder).held is None


def test_a_latch_file_that_is_a_folder_means_latched_and_a_reset_says_why_it_stays(
    folder: StateFolder,
) -> None:
    (folder.path / FILE).mkdir()
    latch = Latch(folder)
    assert latch.held is not None
    with pytest.raises(Unable, match="stays latched"):
        latch.release("looked at it", "Ben")
    assert latch.held is not None


def test_a_disk_that_refuses_leaves_it_latched_in_memory_and_says_so_until_it_takes_it(
    folder: StateFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(latch_module, "AGAIN_S", 0.01)
    full = threading.Event()
    full.set()
    true = StateFile.write

    def write(file: StateFile, document: Any) -> None:
        if full.is_set():
            raise BadFile(file.path, "", "cannot be saved: No space left on device")
        true(file, document)

    monkeypatch.setattr(StateFile, "write", write)
    latch = Latch(folder)
    held = latch.hold("smoke", "Ana")
    latch.head_told()
    assert not latch.kept_within(NET_S)
    assert latch.held == held
    assert "No space left" in latch.not_kept
    full.clear()
    until(lambda: latch.not_kept == "", "the disk takes it")
    assert Latch(folder).held == held


def refuse(file: StateFile, *ignored: Any) -> None:
    raise BadFile(file.path, "", "cannot be saved: No space left on device")


def test_a_reset_on_a_full_disk_leaves_the_file_its_room_for_the_next_stop(
    folder: StateFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    latch = latched(folder)
    monkeypatch.setattr(StateFile, "write", refuse)
    latch.release("aired", "Ben")
    assert latch.held is None
    assert Latch(folder).held is None
    held = latch.hold("sparks", "Cem")
    latch.head_told()
    assert latch.kept_within(NET_S)
    assert Latch(folder).held == held


def test_a_reset_takes_a_file_away_that_cannot_be_written(
    folder: StateFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    latch = latched(folder)
    monkeypatch.setattr(StateFile, "write", refuse)
    monkeypatch.setattr(StateFile, "overwrite", refuse)
    latch.release("aired", "Ben")
    assert latch.held is None
    assert Latch(folder).held is None


def test_a_reset_that_the_disk_refuses_leaves_it_latched_here_and_there_however_often_it_is_asked(
    folder: StateFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    latch = latched(folder)
    with monkeypatch.context() as patch:
        for way in ("write", "overwrite", "remove"):
            patch.setattr(StateFile, way, refuse)
        for _ in range(3):
            with pytest.raises(Unable, match=r"stays latched.*No space"):
                latch.release("aired", "Ben")
            assert latch.held is not None
    assert Latch(folder).held == latch.held
    latch.release("aired", "Ben")
    assert Latch(folder).held is None


def test_a_stop_that_no_disk_ever_took_is_reset_on_that_disk_too(
    folder: StateFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    latch = Latch(folder)
    until((folder.path / FILE).exists, "a file that says that nothing is latched")
    for way in ("write", "overwrite", "remove"):
        monkeypatch.setattr(StateFile, way, refuse)
    latch.hold("smoke", "Ana")
    latch.head_told()
    assert not latch.kept_within(NET_S)
    latch.release("aired", "Ben")
    assert latch.held is None
    assert Latch(folder).held is None


def test_a_stop_that_the_disk_took_in_part_is_no_release_until_the_disk_says_so(
    folder: StateFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def torn(file: StateFile, *ignored: Any) -> None:
        file.path.write_bytes(b"{")
        refuse(file)

    latch = Latch(folder)
    until((folder.path / FILE).exists, "a file that says that nothing is latched")
    with monkeypatch.context() as patch:
        patch.setattr(StateFile, "overwrite", torn)
        for way in ("write", "remove"):
            patch.setattr(StateFile, way, refuse)
        latch.hold("smoke", "Ana")
        latch.head_told()
        assert not latch.kept_within(NET_S)
        with pytest.raises(Unable, match="stays latched"):
            latch.release("aired", "Ben")
    assert latch.held is not None
    assert Latch(folder).held is not None


def test_a_stop_during_a_reset_wins(folder: StateFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    latch = latched(folder)
    true = StateFile.write

    def write(file: StateFile, document: Any) -> None:
        monkeypatch.setattr(StateFile, "write", true)
        true(file, document)
        latch.hold("more smoke", "Cem")

    monkeypatch.setattr(StateFile, "write", write)
    with pytest.raises(NotNow, match="another emergency stop"):
        latch.release("aired", "Ben")
    assert latch.held is not None
    until(lambda: Latch(folder).held == latch.held, "the disk holds it again")


def test_a_stop_is_written_over_the_file_that_is_there_from_the_start(folder: StateFolder) -> None:
    latch, path = Latch(folder), folder.path / FILE
    until(path.exists, "a file that says that nothing is latched")
    for _ in range(2):
        before = path.stat().st_ino
        latch.hold("smoke " * 100, "\U0001f525" * 500)  # six bytes and twelve a character
        latch.head_told()
        assert latch.kept_within(NET_S)
        assert path.stat().st_ino == before
        assert Latch(folder).held == latch.held
        latch.release("aired", "Ben")
        assert path.stat().st_ino != before
        assert Latch(folder).held is None


@pytest.mark.parametrize("reason", ["smoke", "\U0001f525" * 200])
def test_a_power_cut_while_a_stop_is_written_leaves_what_is_latched_or_cannot_be_read(
    folder: StateFolder, reason: str
) -> None:
    latch, path = Latch(folder), folder.path / FILE
    latch.hold("sparks", "Ana")
    latch.release("\U0001f525" * 200, "Ben")
    old = path.read_bytes()
    latch.hold(reason, "Cem")
    latch.head_told()
    assert latch.kept_within(NET_S)
    new = path.read_bytes()
    assert len(new) == len(old)
    parts = [slice(at, at + SECTOR_BYTES) for at in range(0, len(new), SECTOR_BYTES)]
    chance = random.Random(1)
    for _ in range(100):
        mixed = [new[parts[0]], *(chance.choice((old, new))[part] for part in parts[1:])]
        path.write_bytes(b"".join(mixed))
        assert Latch(folder).held is not None
    path.write_bytes(b"".join([old[parts[0]], *(new[part] for part in parts[1:])]))
    Latch(folder)  # before its first sector nothing was told; it starts


def test_a_file_that_cannot_be_written_over_is_written_anew(
    folder: StateFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(descriptor: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    latch = Latch(folder)
    until((folder.path / FILE).exists, "a file that says that nothing is latched")
    monkeypatch.setattr(os, "fdatasync", refuse)
    latch.hold("smoke", "Ana")
    latch.head_told()
    assert latch.kept_within(NET_S)
    assert Latch(folder).held == latch.held


def test_nobody_is_told_that_the_disk_holds_a_stop_while_a_reset_writes_there(
    folder: StateFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    latch = latched(folder)
    told = []
    true = StateFile.write

    def write(file: StateFile, document: Any) -> None:
        monkeypatch.setattr(StateFile, "write", true)
        true(file, document)
        latch.hold("more smoke", "Cem")  # a restart at this moment would find nothing latched
        told.append((latch.survives, latch.kept_within(0.02)))

    monkeypatch.setattr(StateFile, "write", write)
    with pytest.raises(NotNow, match="another emergency stop"):
        latch.release("aired", "Ben")
    assert told == [(False, False)]
    assert latch.kept_within(NET_S)
    assert Latch(folder).held == latch.held


@pytest.mark.parametrize("words", ["a \ud800 b", "a \x1b[2J b", "a \0 b"])
def test_words_that_no_terminal_and_no_answer_can_hold_are_kept_without_them(
    folder: StateFolder, words: str, caplog: pytest.LogCaptureFixture
) -> None:
    latch = Latch(folder)
    latch.hold(words, words)
    latch.head_told()
    assert latch.kept_within(NET_S)
    found = Latch(folder).held
    assert found is not None
    assert found.reason == found.name == latch.release(words, words).reason
    assert found.reason.startswith("a ?")
    StateFile(folder.path / FILE, latch_module.SCHEMA).write(
        {"latched": True, "reason": words, "name": words}
    )
    by_hand = Latch(folder).held
    assert by_hand is not None
    assert by_hand.reason.startswith("a ?")
    assert not [line for line in caplog.messages if words in line]


def test_what_was_never_latched_cannot_be_released(folder: StateFolder) -> None:
    with pytest.raises(NotNow, match="no emergency stop"):
        Latch(folder).release("a reason", "a name")


# The folder


def test_a_second_daemon_does_not_get_the_folder(folder: StateFolder) -> None:
    with pytest.raises(StateInUse, match=r"in use by another daemon.*state\.folder"):
        StateFolder(folder.path)
    folder.close()
    StateFolder(folder.path).close()


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
    for named, expected in ((None, tmp_path / "one"), (tmp_path / "told", tmp_path / "told")):
        made = StateFolder.of(named, tmp_path / "rover.yaml", "http://127.0.0.1:1")
        assert made.path == expected
        made.close()


def test_a_temporary_folder_goes_also_when_somebody_still_writes(monkeypatch: pytest.MonkeyPatch) -> None:
    made = StateFolder.temporary()
    (made.path / "latch.json").write_text("{}")

    def removed(path: Path, ignore_errors: bool) -> None:
        for file in path.iterdir():
            file.unlink()
        for late in (lambda: (made.path / "late.json").write_text("{}"), path.rmdir):
            with suppress(OSError):
                late()

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", removed)
        made.close()
    assert not [*made.path.parent.glob(f"{made.path.name}*")]


def test_a_usual_place_that_cannot_be_made_is_replaced_and_told_a_named_one_is_insisted_upon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    made = StateFolder.of(None, tmp_path / "rover.yaml", "http://127.0.0.1:1")
    assert made.is_temporary
    assert "cannot be made" in made.why_temporary
    made.close()
    assert not made.path.exists()
    with pytest.raises(BadFile, match="cannot be made"):
        StateFolder.of(tmp_path / "file" / "in", tmp_path / "rover.yaml", "http://127.0.0.1:1")


# The daemon


def test_after_an_emergency_stop_nothing_moves_whatever_way_it_comes(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with fake_daemon(monkeypatch, tmp_path, config=KEPT) as (daemon, hardware), Client(daemon.url) as client:
        told = client.estop(reason="sparks", name="Ana")
        assert (told["stopped"], told["latched"], told["kept"]) == (True, True, True)
        assert hardware.head.calls.count(("stop",)) == 1
        status = client.status()
        assert (status["state"], status["estop"]["name"]) == ("stopped", "Ana")
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


def test_an_emergency_stop_ends_the_running_operation(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with fake_daemon(monkeypatch, tmp_path) as (daemon, _), Client(daemon.url) as client:
        begun = threading.Event()

        def wait(request: Any, record: Any, cancelled: threading.Event, devices: Any) -> Any:
            begun.set()
            assert cancelled.wait(NET_S)
            devices.move(0.1, 0.1)

        monkeypatch.setattr(ScriptedLoop, "script", staticmethod(wait))
        operation = client.point(pan_rad=0.1, tilt_rad=0.1)
        assert begun.wait(NET_S)
        assert client.estop(reason="sparks")["operation"] == operation
        record = client.wait(operation)
        assert record["state"] == "stopped"
        assert "sparks" in record["error"]["message"]


def test_an_operation_that_slips_in_while_it_is_latched_fails_at_the_gate(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with fake_daemon(monkeypatch, tmp_path) as (daemon, hardware), Client(daemon.url) as client:
        monkeypatch.setattr(machine_module, "refusal_of", lambda now, need: None)
        client.estop()
        record = client.wait(client.point(pan_rad=0.1, tilt_rad=0.1))
        assert (record["state"], record["error"]["code"]) == ("failed", "estopped")
        assert not [call for call in hardware.head.calls if call[0] == "move"]


@pytest.mark.parametrize(
    ("body", "kind", "reason"),
    [
        (b"", "", "no reason given"),
        (b"{", "application/json", "no reason given"),
        (b'{"reason": 3}', "text/plain", "no reason given"),
        (b'["reason"]', "application/json", "no reason given"),
        (b'{"reason": "x", "reason": "y", "more": NaN}', "application/json", "y"),
        (b'{"reason": "a \\ud800 b"}', "application/json", "a ? b"),
        (b'{"reason": "' + b"x" * 300 + b'"}', "application/json", "x" * 200),
        (b"x" * 100_000, "application/json", "no reason given"),
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
        assert status.json()["estop"]["reason"] == reason
        assert ("stop",) in hardware.head.calls


@pytest.mark.parametrize(
    "body",
    [{}, {"reason": "x"}, {"name": "x"}, {"reason": " ", "name": "x"}, {"reason": "x", "name": "y" * 201}],
)
def test_a_reset_needs_a_reason_and_a_name(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, body: dict[str, str]
) -> None:
    with fake_daemon(monkeypatch, tmp_path) as (daemon, _), Client(daemon.url) as client:
        client.estop()
        answer = httpx.post(f"{daemon.url}/api/v1/reset", json=body, timeout=NET_S)
        assert (answer.status_code, answer.json()["error"]["code"]) == (422, "bad_request")
        assert daemon.service.latch.held is not None


def test_a_reset_waits_for_a_stop_that_is_under_way(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    hang = Hang()
    with fake_daemon(monkeypatch, tmp_path) as (daemon, hardware), Client(daemon.url) as client:
        client.estop()
        with monkeypatch.context() as patch:
            patch.setattr(hardware.head, "stop", hang)
            stopping = threading.Thread(target=stop, args=(daemon.url,))
            stopping.start()
            until(lambda: daemon.service.devices.stop_pending, "the stop")
            with pytest.raises(ClientError, match="being stopped") as refused:
                client.reset(reason="x", name="y")
            assert refused.value.code == "stopping"
            hang.let_go()
            stopping.join(NET_S)
        until(lambda: not daemon.service.machine.standing.stops, "the stop's end")
        client.reset(reason="x", name="y")


def test_a_stop_in_the_middle_of_a_reset_leaves_nothing_latched_and_the_next_command_starts(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with fake_daemon(monkeypatch, tmp_path, config=KEPT) as (daemon, hardware), Client(daemon.url) as client:
        service = daemon.service
        client.estop(reason="sparks", name="Ana")
        true = service.latch.release

        def release(reason: str, name: str, latched_by: str | None) -> Latched:
            held = true(reason, name, latched_by)
            service.machine.stop_asked()
            return held

        monkeypatch.setattr(service.latch, "release", release)
        client.reset(reason="looked", name="Ben")
        assert (service.machine.standing.word, service.machine.standing.latch) == ("stopping", None)
        service.machine.stop_ended()
        assert client.status()["state"] == "holding"
        with pytest.raises(ClientError) as refused:
            client.reset(reason="looked", name="Ben")
        assert refused.value.code == "not_estopped"
        client.wait(client.point(pan_rad=0.1, tilt_rad=0.1))
        assert [call for call in hardware.head.calls if call[0] == "move"]


def test_an_emergency_stop_in_the_middle_of_a_reset_is_latched_everywhere(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with fake_daemon(monkeypatch, tmp_path, config=KEPT) as (daemon, _), Client(daemon.url) as client:
        service = daemon.service
        client.estop(reason="sparks", name="Ana")
        true = service.latch.release

        def release(reason: str, name: str, latched_by: str | None) -> Latched:
            held = true(reason, name, latched_by)
            service.stopping.latch_estop("smoke", "Cem")
            return held

        with monkeypatch.context() as patch:
            patch.setattr(service.latch, "release", release)
            client.reset(reason="looked", name="Ben")
        status = client.status()
        assert (status["state"], status["estop"]["name"]) == ("stopped", "Cem")
        with pytest.raises(Estopped, match="smoke"):
            service.devices.move(0.1, 0.1)
        assert client.reset(reason="looked", name="Ben")["released"]["name"] == "Cem"
        client.wait(client.point(pan_rad=0.1, tilt_rad=0.1))


def test_what_is_latched_where_no_stop_could_be_sent_can_be_reset(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with fake_daemon(monkeypatch, tmp_path, config=KEPT) as (daemon, _), Client(daemon.url) as client:
        daemon.service.stopping.latch_estop("smoke", "Ana")
        assert client.status()["state"] == "stopped"
        assert client.reset(reason="looked", name="Ben")["released"]["name"] == "Ana"


def stop(url: str) -> None:
    with contextlib.suppress(ClientError), Client(url) as client:
        client.stop()


def test_a_head_that_does_not_confirm_is_told_and_the_stop_is_latched_all_the_same(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def refuse() -> None:
        raise DriverError("the cable is cut")

    with fake_daemon(monkeypatch, tmp_path, config=KEPT) as (daemon, hardware), Client(daemon.url) as client:
        with monkeypatch.context() as patch:
            patch.setattr(hardware.head, "stop", refuse)
            with pytest.raises(ClientError, match=r"latched, but the head did not confirm.*cable") as told:
                client.estop(name="Ana")
            assert told.value.code == "stop_unconfirmed"
        assert client.status()["estop"]["name"] == "Ana"
        assert (tmp_path / "state" / FILE).exists()


def test_stops_that_all_hang_do_not_keep_an_emergency_stop_from_the_gate(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    hang = Hang()
    monkeypatch.setattr(stop_threads, "OVERDUE_S", 0.05)
    with fake_daemon(monkeypatch, tmp_path) as (daemon, _), Client(daemon.url) as client:
        futures = [daemon.service.stop_threads.submit(hang) for _ in range(stop_threads.THREADS)]
        began = daemon.service.stop_threads._began_s
        for future in futures:
            until(lambda future=future: future in began, "the stops are under way")
            began[future] -= 1.0
        with pytest.raises(ClientError, match="latched, but") as told:
            client.estop(name="Ana")
        assert told.value.code == "stop_unconfirmed"
        with pytest.raises(Estopped):
            daemon.service.devices.move(0.1, 0.1)
        hang.let_go()


def test_a_disk_that_hangs_holds_the_answer_for_a_bounded_time_and_the_answer_says_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    hang = Hang()
    with fake_daemon(monkeypatch, tmp_path, config=KEPT) as (daemon, hardware), Client(daemon.url) as client:
        for way in ("write", "overwrite"):
            monkeypatch.setattr(StateFile, way, hang)
        monkeypatch.setattr(stopping_module, "KEPT_S", 0.05)
        told = client.estop()
        assert (told["latched"], told["kept"]) == (True, False)
        assert "would not survive" in told["message"]
        assert ("stop",) in hardware.head.calls
        (fault,) = client.status()["faults"]
        assert (fault["device"], fault["code"]) == ("state", "latch_not_kept")
        monkeypatch.undo()
        hang.let_go()


def test_a_daemon_that_starts_latched_sends_the_head_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with fake_daemon(monkeypatch, tmp_path, config=KEPT) as (daemon, _), Client(daemon.url) as client:
        client.estop(reason="sparks", name="Ana")
    with fake_daemon(monkeypatch, tmp_path, config=KEPT) as (daemon, hardware), Client(daemon.url) as client:
        status = client.status()
        assert (status["state"], status["estop"]["reason"]) == ("stopped", "sparks")
        with pytest.raises(ClientError, match="latched"):
            client.point(pan_rad=0.1, tilt_rad=0.1)
        assert not [call for call in hardware.head.calls if call[0] in ("move", "stop")]


# A daemon in a process of its own


def test_killed_right_after_the_answer_it_comes_back_latched(tmp_path: Path) -> None:
    config = write_config(tmp_path, f"{{port: {free_port()}}}")
    with daemon_process(tmp_path, config) as daemon, Client(line(daemon)) as client:
        under_way(client)
        told = client.estop(reason="sparks", name="Ana")
        os.kill(daemon.pid, 9)
        assert told["kept"] is True
    (tmp_path / "head.log").unlink()
    with daemon_process(tmp_path, config) as daemon, Client(line(daemon)) as client:
        assert client.status()["estop"]["name"] == "Ana"
        with pytest.raises(ClientError, match="latched"):
            client.point(pan_rad=0.1, tilt_rad=0.0)
        assert not (tmp_path / "head.log").exists()
        client.reset(reason="looked", name="Ben")
        os.kill(daemon.pid, 9)
    with daemon_process(tmp_path, config) as daemon, Client(line(daemon)) as client:
        assert client.status()["estop"] is None


def test_a_second_daemon_of_one_state_folder_does_not_touch_the_head(tmp_path: Path) -> None:
    config = write_config(tmp_path)
    config.write_text(config.read_text() + "state: {folder: state}\n")
    with daemon_process(tmp_path, config) as daemon:
        line(daemon)
        with daemon_process(tmp_path, config) as second:
            _, words = second.communicate(timeout=NET_S)
        assert second.returncode == 1
        assert "is in use by another daemon" in words.splitlines()[-1]
        assert "Traceback" not in words
