"""Stop comes first: whatever hangs, is locked or raises, the head is stopped, and what runs ends at once."""

from __future__ import annotations

import contextlib
import logging
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.faults import FaultPanel
from hil_tests.mastctl.service_fakes import HTTP, FakeHardware, Hang, fake_daemon
from hil_tests.waiting import NET_S, joined, present, until
from mastctl.client import Client, ClientError
from mastctl.daemon import RunningDaemon
from mastctl.motion.loop import PointingLoop
from mastctl.service import stopping as stopping_module
from mastctl.web import commands as commands_module


def asked_to_stop(daemon: RunningDaemon) -> threading.Thread:
    """A client that asks for a stop in a thread of its own, and may wait long for the answer."""

    def stop() -> None:
        with contextlib.suppress(ClientError), Client(daemon.url) as client:
            client.stop()

    asking = threading.Thread(target=stop)
    asking.start()
    return asking


def test_the_head_is_stopped_before_the_track_and_before_any_log(
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
            until(lambda: ("stop",) in hardware.head.calls, "the head is stopped, while the log hangs")
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
        for one in ("Masts._lock", "OperationRunner._changed", "Tracker._lock", "FrameStore._lock"):
            assert one in found
        for place, lock in found.items():
            with lock:
                waiting = [asked(daemon.url, *request) for request in MAY_WAIT]
                for path in 2 * ("/status", "/track", "/operations", f"/operations/{operation}", "/mast"):
                    answer = HTTP.get(f"{daemon.url}/api/v1{path}")
                    assert answer.status_code == 200, f"{path} while {place} is held"
            for line in waiting:
                with line:
                    assert line.recv(65536).startswith(b"HTTP/1.1 "), f"after {place} was held"
            client.stop()
            until(lambda: client.status()["operation"] is None, "the end of what was started")


def test_a_fifth_stop_is_answered_honestly_while_four_hang(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    hang = Hang()
    monkeypatch.setattr(stopping_module, "OVERDUE_S", 0.2)
    with fake_daemon(monkeypatch, tmp_path) as (daemon, _):
        monkeypatch.setattr(commands_module, "STOP_ANSWER_S", 0.5)
        monkeypatch.setattr(daemon.service.stopping, "stop", hang)
        outcome: list[ClientError] = []
        four = [asked_to_stop(daemon) for _ in range(4)]

        def refused() -> bool:
            with Client(daemon.url) as client:
                try:
                    client.stop()
                except ClientError as error:
                    outcome.append(error)
            return bool(outcome) and "4 stops are under way" in str(outcome[-1])

        until(refused, "an answer to the fifth")
        assert outcome[-1].code == "stop_pending"
        assert "may still move" in str(outcome[-1])
        hang.let_go()
        joined(*four)


# Operations


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
    monkeypatch.setattr("mastctl.motion.measurement.FRAME_TIMEOUT_S", 2.0 * NET_S)
    with (
        fake_daemon(monkeypatch, tmp_path, loop=PointingLoop) as (daemon, hardware),  # type: ignore[arg-type]
        Client(daemon.url) as client,
    ):
        operation = waiting_pointing(client, hardware, hang)
        client.stop()
        until(lambda: client.operation(operation)["state"] == "stopped", "the end")
        assert present(client.operation(operation)["error"])["message"] == "a stop was requested"
        assert client.status()["state"] == "holding"
        assert client.wait(client.point(pan_rad=0.1, tilt_rad=0.1))["state"] == "done"
        hang.let_go()
