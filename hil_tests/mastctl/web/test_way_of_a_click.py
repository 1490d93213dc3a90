"""The rooms and modules that a click passes before its operation starts, from the calls themselves."""

from __future__ import annotations

import threading
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from hil_tests.mastctl.service_fakes import fake_daemon
from hil_tests.waiting import NET_S
from mastctl.client import Client

WAY = ("daemon", "request")  # the threads that a request goes through until the operation has its own
ROOMS = {"http", "web", "control", "service", "motion", "devices"}
MOST_MODULES = 26
CALLED_BACK = {("control", "web"), ("web", "http")}
"""The entry calls what carries the command out, and a route asks the guard before it does."""


class Calls:
    """Calls from room to room of `mastctl` in the threads of a request, until the operation's own begins."""

    def __init__(self, package: Path) -> None:
        self.modules: set[str] = set()
        self.between: set[tuple[str, str]] = set()
        self.sent, self.begun = threading.Event(), threading.Event()
        self._package = f"{package}/"

    def __call__(self, frame: FrameType, event: str, argument: Any) -> None:
        """Note a call, as `threading.setprofile` tells it."""
        name = threading.current_thread().name
        if event != "call" or not self.sent.is_set() or self.begun.is_set():
            return
        if name.startswith("operation "):
            self.begun.set()
        elif name in WAY and (room := self._room(frame)):
            self.modules.add(frame.f_code.co_filename.removeprefix(self._package))
            above = frame.f_back
            while above is not None and not self._room(above):
                above = above.f_back
            if above is not None and self._room(above) != room:
                self.between.add((self._room(above), room))

    def _room(self, frame: FrameType) -> str:
        """The folder that a function is in; empty for those in none."""
        file = frame.f_code.co_filename
        room, _, module = file.removeprefix(self._package).partition("/")
        return room if file.startswith(self._package) and module not in ("", "__init__.py") else ""


def test_a_click_goes_down_through_six_rooms_and_is_called_back_twice(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, repository: Path
) -> None:
    calls = Calls(repository / "mastctl")
    threading.setprofile(calls)
    try:
        with fake_daemon(monkeypatch, tmp_path) as (daemon, _), Client(daemon.url) as client:
            frame_id = client.snapshot("navcam_left").frame_id
            calls.sent.set()
            client.point(pixel=("navcam_left", frame_id, 20.0, 20.0))
            assert calls.begun.wait(NET_S)
    finally:
        threading.setprofile(None)  # type: ignore[arg-type]
    assert {one.partition("/")[0] for one in calls.modules} == ROOMS
    assert len(calls.modules) <= MOST_MODULES, sorted(calls.modules)
    both_ways = {one for one in calls.between if one[::-1] in calls.between}
    assert both_ways == CALLED_BACK | {one[::-1] for one in CALLED_BACK}
