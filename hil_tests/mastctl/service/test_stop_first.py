"""Stop comes first: whatever hangs, is locked or raises, the head is told, and what runs ends at once."""

from __future__ import annotations

import contextlib
import logging
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from drivers.clock import SystemClock
from drivers.errors import DriverError
from drivers.faults import FaultPanel
from hil_tests.mastctl.service_fakes import HTTP, FakeHardware, Hang, ScriptedLoop, fake_daemon
from hil_tests.waiting import NET_S, joined, until
from mastctl.client import Client, ClientError
from mastctl.control import operations as operations_module
from mastctl.control.operations import OperationRunner
from mastctl.control.records import Operation
from mastctl.daemon import RunningDaemon
from mastctl.errors import Stopped, Unable
from mastctl.motion import tracker as tracker_module
from mastctl.motion.loop import PointingLoop
from mastctl.safety import stop_threads as stop_threads_module
from mastctl.web import commands as commands_module


def asked_to_stop(daemon: RunningDaemon) -> threading.Thread:
    """A client that asks for a stop in a thread of its own, and may wait long for the answer."""

    def stop() -> None:
        with contextlib.suppress(ClientError), Client(daemon.url) as client:
            client.stop()

    asking = threading.Thread(target=stop)
    asking.start()
    return asking


def test_the_head_is_told_before_the_track_and_before_any_word(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    hang = Hang()
    handler = logging.Handler()
    monkeypatch.setattr(handler, "emit", hang)
    with fake_daemon(monkeypatch, tmp_path) as (daemon, hardware):
        monkeypatch.setattr(daemon.service.tracker, "stop", hang)
        logger = logging.getLogger("mastctl")
        before = logger.level
        logger.addHandler(handler)
        logger.setLevel(logging.INFO)
        stopping = asked_to_stop(daemon)
        try:
            until(lambda: ("stop",) in hardware.head.calls, "the head is told, while the words hang")
        finally:
            logger.removeHandler(handler)
            logger.setLevel(before)
            hang.let_go()
            joined(stopping)


# Locks

MAY_WAIT = (
    ("POST", "/point"), ("POST", "/pose"), ("POST", "/track"), ("POST", "/track/look"),
    ("POST", "/simulation/faults"), ("GET", "/simulation/faults"), ("POST", "/mast/back"),
)  # fmt: skip
"""What may wait for a lock that somebody holds."""


def asked(url: str, method: str, path: str) -> socket.socket:
    """A connection on which a request was sent, and nothing read."""
    body = '{"pan_rad": 0.1, "tilt_rad": 0.1}' if path == "/point" else '{"device": "pan_tilt"}'
    host, port = url.removeprefix("http://").split(":")
    line = socket.create_connection((host, int(port)), timeout=NET_S)
    head = (
        f"Host: {host}\r\nConnection: close\r\nContent-Type: application/json\r\nContent-Length: {len(body)}"
    )
    line.sendall(f"{method} /api/v1{path} HTTP/1.1\r\n{head}\r\n\r\n{body}".encode())
    return line


def locks_of(thing: Any, seen: set[int]) -> Iterator[tuple[str, Any]]:
    """Every lock that hangs on the service, with its place."""
    kinds = (type(threading.Lock()), type(threading.RLock()), threading.Condition)
    if id(thing) in seen:
        return
    seen.add(id(thing))
    for name, value in (thing if isinstance(thing, dict) else vars(thing)).copy().items():
        if isinstance(value, kinds):
            yield f"{type(thing).__name__}.{name}", value
        elif isinstance(value, dict) or (
            type(value).__module__.startswith(("mastctl.", "drivers.")) and hasattr(value, "__dict__")
        ):
            yield from locks_of(value, seen)


def test_no_lock_that_somebody_holds_keeps_the_event_loop(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with fake_daemon(monkeypatch, tmp_path) as (daemon, hardware), Client(daemon.url) as client:
        hardware.simulation = type("Simulated", (), {})()
        hardware.simulation.faults = FaultPanel(time.monotonic, hardware.cameras)
        operation = client.point(pan_rad=0.1, tilt_rad=0.1)
        client.wait(operation)
        client.snapshot("navcam_left")
        found = dict(locks_of(daemon.service, set()))
        found["FaultPanel._lock"] = hardware.simulation.faults._lock
        for one in ("Masts._lock", "OperationRunner._lock", "Tracker._lock", "FrameStore._lock"):
            assert one in found
        for place, lock in found.items():
            with lock:
                waiting = [asked(daemon.url, *request) for request in MAY_WAIT]
                for path in 2 * ("/status", "/track", "/operations", f"/operations/{operation}", "/mast"):
                    answer = HTTP.get(f"{daemon.url}/api/v1{path}")
                    assert answer.status_code == 200, f"{path} while {place} is held"
            for one in waiting:
                with one:
                    assert one.recv(65536).startswith(b"HTTP/1.1 "), f"after {place} was held"
            client.stop()
            until(lambda: client.status()["operation"] is None, "the end of what was started")


def test_a_lock_of_the_bookkeeping_does_not_keep_a_stop_from_the_head(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with fake_daemon(monkeypatch, tmp_path) as (daemon, hardware):
        service = daemon.service
        for lock in (
            service.masts._lock, service.operations._lock, service.tracker._lock, service.handoffs._lock,
            service.devices._store._lock, service.machine._turns._lock,
            service.machine.publisher._turns._lock,
        ):  # fmt: skip
            hardware.head.calls.clear()
            with lock:
                stopping = asked_to_stop(daemon)
                until(lambda: ("stop",) in hardware.head.calls, "the head is told")
            joined(stopping)


def test_a_fifth_stop_is_answered_honestly_while_four_hang(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    hang = Hang()
    monkeypatch.setattr(stop_threads_module, "OVERDUE_S", 0.2)
    with fake_daemon(monkeypatch, tmp_path) as (daemon, _):
        monkeypatch.setattr(commands_module, "STOP_ANSWER_S", 0.5)
        monkeypatch.setattr(daemon.service.stopping, "stop", hang)
        told: list[ClientError] = []
        four = [asked_to_stop(daemon) for _ in range(4)]

        def refused() -> bool:
            with Client(daemon.url) as client:
                try:
                    client.stop()
                except ClientError as error:
                    told.append(error)
            return bool(told) and "4 stops are under way" in str(told[-1])

        until(refused, "an answer to the fifth")
        assert told[-1].code == "stop_pending"
        assert "may still move" in str(told[-1])
        hang.let_go()
        joined(*four)


# Operations


def test_an_operation_without_a_thread_is_refused_and_the_next_one_runs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    class NoThread(threading.Thread):
        def start(self) -> None:
            raise RuntimeError("can't start new thread")

    with fake_daemon(monkeypatch, tmp_path) as (daemon, _), Client(daemon.url) as client:
        with monkeypatch.context() as patch:
            patch.setattr(operations_module.threading, "Thread", NoThread)
            with pytest.raises(Unable, match="can't start new thread"):
                daemon.service.operations.start({}, lambda record, cancelled: None)
        assert daemon.service.operations.all()[0].state == "failed"
        assert client.status()["operation"] is None
        assert client.wait(client.point(pan_rad=0.1, tilt_rad=0.1))["state"] == "done"


@pytest.mark.parametrize(
    "raised", [ValueError("what?"), RuntimeError("can't start new thread"), SystemExit(3)]
)
def test_a_stop_that_raises_anything_leaves_room_for_the_next_operation(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, raised: BaseException
) -> None:
    def fail(*_: Any) -> None:
        raise ValueError("a defect")

    def broken() -> None:
        raise raised

    with fake_daemon(monkeypatch, tmp_path) as (daemon, _), Client(daemon.url) as client:
        with monkeypatch.context() as patch:
            patch.setattr(ScriptedLoop, "script", staticmethod(fail))
            patch.setattr(daemon.service.devices, "stop", broken)
            record = client.wait(client.point(pan_rad=0.1, tilt_rad=0.1), timeout_s=NET_S)
        assert record["state"] == "failed"
        assert client.wait(client.point(pan_rad=0.1, tilt_rad=0.1))["state"] == "done"


def test_a_result_and_an_error_that_cannot_be_told_leave_room_too(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    class Mute(DriverError):
        def __str__(self) -> str:
            raise ValueError("no words")

    class Odd:
        @property
        def pointings(self) -> Any:
            raise ValueError("no pointings")

    def fail(*_: Any) -> None:
        raise Mute("", device="pan_tilt")

    with fake_daemon(monkeypatch, tmp_path) as (daemon, _), Client(daemon.url) as client:
        monkeypatch.setattr(ScriptedLoop, "script", staticmethod(fail))
        assert client.wait(client.point(pan_rad=0.1, tilt_rad=0.1), timeout_s=NET_S)["state"] == "failed"
        monkeypatch.setattr(ScriptedLoop, "script", staticmethod(lambda *_: Odd()))
        assert client.wait(client.point(pan_rad=0.1, tilt_rad=0.1), timeout_s=NET_S)["state"] == "done"


def test_nothing_starts_and_nothing_moves_while_a_stop_is_under_way(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    hang = Hang()
    with fake_daemon(monkeypatch, tmp_path) as (daemon, hardware), Client(daemon.url) as client:
        hardware.head.hook = lambda name: hang() if name == "stop" else None
        stopping = asked_to_stop(daemon)
        assert hang.entered.wait(NET_S)
        assert client.status()["state"] == "stopping"
        with pytest.raises(ClientError) as refused:
            client.point(pan_rad=0.1, tilt_rad=0.1)
        assert refused.value.code == "stopping"
        hang.let_go()
        joined(stopping)
        assert client.status()["state"] == "holding"
        assert client.wait(client.point(pan_rad=0.1, tilt_rad=0.1))["state"] == "done"


class ScriptedMover:
    """What stops the mast: the first stop returns when ``first`` has, the others at once."""

    def __init__(self, first: Callable[[], None]) -> None:
        self._first = [first]

    def stop(self) -> None:
        if self._first:
            self._first.pop()()

    def block_moves(self, holder: object, reason: str) -> None: ...
    def allow_moves(self, holder: object) -> None: ...


def test_an_operation_that_ends_while_the_head_is_being_stopped_was_stopped_by_that() -> None:
    go = threading.Event()

    def refused(record: Any, cancelled: threading.Event) -> None:
        assert go.wait(NET_S)
        raise Stopped("a move was refused, since the mast is being stopped")

    def until_it_has_ended() -> None:
        go.set()
        until(lambda: operations.running is None, "the operation's end")

    operations = OperationRunner(ScriptedMover(until_it_has_ended), SystemClock())
    name = operations.start({}, refused).id
    assert operations.stop() == name
    record = operations.get(name).told()
    assert (record["state"], record["error"]["message"]) == ("stopped", "a stop was asked for")


def test_an_operation_that_was_done_before_its_stop_is_not_told_as_stopped() -> None:
    go = threading.Event()

    def until_it_has_ended() -> None:
        go.set()
        until(lambda: operations.running is None, "the operation's end")

    operations = OperationRunner(ScriptedMover(until_it_has_ended), SystemClock())
    name = operations.start({}, lambda record, cancelled: go.wait(NET_S)).id
    assert operations.stop() is None
    assert operations.get(name).state == "done"


def test_closing_twice_asks_the_head_once() -> None:
    stops: list[str] = []
    mover = ScriptedMover(lambda: stops.append("first"))
    operations = OperationRunner(mover, SystemClock())
    operations.close()
    mover.stop = lambda: stops.append("again, of devices that may be closed by now")  # type: ignore[method-assign]
    operations.close()
    assert stops == ["first"]


def test_whoever_sees_a_record_that_has_ended_sees_no_operation_running() -> None:
    operations = OperationRunner(ScriptedMover(lambda: None), SystemClock())
    seen: list[str | None] = []
    keep = operations._keep

    def keep_and_look(operation: Operation) -> None:
        keep(operation)
        if operation.ended_s is not None:
            seen.append(operations.running)

    operations._keep = keep_and_look  # type: ignore[method-assign]
    operations.start({}, lambda record, cancelled: None)
    until(lambda: seen == [None], "the end, seen as one")


class PatientLoop(PointingLoop):
    """A loop that would wait for a picture longer than any net."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self._settings = replace(self._settings, frame_timeout_s=2.0 * NET_S)


def waiting_pointing(client: Client, hardware: FakeHardware, hang: Hang) -> str:
    """A pointing that waits for a picture of a camera that hangs."""
    frame_id = client.snapshot("navcam_left").frame_id
    hardware.fake_cameras["navcam_left"].hook = hang
    operation = client.point(pixel=("navcam_left", frame_id, 30.0, 20.0))
    assert hang.entered.wait(NET_S)
    return operation


def test_a_stop_ends_a_pointing_that_waits_for_a_picture(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    hang = Hang()
    with (
        fake_daemon(monkeypatch, tmp_path, loop=PatientLoop) as (daemon, hardware),  # type: ignore[arg-type]
        Client(daemon.url) as client,
    ):
        operation = waiting_pointing(client, hardware, hang)
        client.stop()
        until(lambda: client.operation(operation)["state"] == "stopped", "the end")
        assert client.operation(operation)["error"]["message"] == "a stop was asked for"
        assert client.status()["state"] == "holding"
        assert client.wait(client.point(pan_rad=0.1, tilt_rad=0.1))["state"] == "done"
        hang.let_go()


def test_a_stop_that_an_operation_has_not_heeded_yet_is_told_as_stopping(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    entered, leave = threading.Event(), threading.Event()

    def deaf(*_: Any) -> None:
        entered.set()
        leave.wait(NET_S)

    with fake_daemon(monkeypatch, tmp_path) as (daemon, _), Client(daemon.url) as client:
        monkeypatch.setattr(ScriptedLoop, "script", staticmethod(deaf))
        client.point(pan_rad=0.1, tilt_rad=0.1)
        assert entered.wait(NET_S)
        assert client.status()["state"] == "moving"
        client.stop()
        assert client.status()["state"] == "stopping"
        with pytest.raises(ClientError, match="is being stopped") as refused:
            client.point(pan_rad=0.1, tilt_rad=0.1)
        assert refused.value.code == "stopping"
        leave.set()
        until(lambda: client.status()["state"] == "holding", "the end")


def test_a_defect_at_the_end_of_a_look_ends_the_track_instead_of_keeping_it_busy(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def fail(*_: Any) -> None:
        raise ValueError("a defect")

    with fake_daemon(monkeypatch, tmp_path) as (daemon, _), Client(daemon.url) as client:
        monkeypatch.setattr(tracker_module, "started", fail)
        frame_id = client.snapshot("navcam_left").frame_id
        client.start_track(pixel=("navcam_left", frame_id, 30.0, 20.0))
        until(lambda: client.track()["state"] == "stopped", "the end of the track")
        assert "defect" in client.track()["reason"]
        assert client.track()["operation"] is None
