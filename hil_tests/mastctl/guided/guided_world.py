"""A guide without a daemon: real leases, publisher and folders; a child that does what a test writes."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from drivers.clock import SystemClock
from hil_tests.waiting import NET_S, until
from mastctl.control.lease import LeaseTable
from mastctl.control.publisher import Publisher
from mastctl.guided.guide import Guide, RunRequest, WayIn
from mastctl.guided.runs import GuidedFolder
from mastctl.guided.told import GuidedRun

PLACE = {
    "event": "place", "name": "p1", "range_m": 1.1, "bearing_deg": 0.0, "height_deg": 0.0,
    "turned_deg": [20.0, 0.0], "description": "straight ahead", "needs_confirmation": True,
}  # fmt: skip
BEGUN = {
    "event": "begun", "board_m": [0.55, 0.33], "cameras": {"navcam_left": [1024, 768]}, "folder": "seen",
    "simulated": True,
}  # fmt: skip
PROGRESS = {
    "event": "progress", "placement": "p1", "pictures": 3, "most": 60, "predicted_px": 6.2,
    "target_px": 0.2, "counts_px": 0.03, "next_rad": [0.3, -0.1], "expected_px": 3.7,
    "cells": {"navcam_left": [2] * 48},
}  # fmt: skip
DONE = {
    "event": "done",
    "result": {
        "verdict": {
            "grade": "good", "words": "trust it", "reasons": [{"grade": "good", "sentence": "all well"}],
        },
        "rms_px": {"navcam_left": [0.05, 0.06]}, "check_rms_px": {"navcam_left": [0.07, 0.08]},
        "check": {
            "promised_px": {"navcam_left": 0.09}, "pointings": [1, 2], "pointing_rms_px": [0.1, 0.2],
            "pointing_promised_px": 0.15,
        },
        "calibrated_px": 0.1, "counts_px": 0.03, "pictures": 18, "placements": 2, "rover_seconds": 35.0,
        "gauges": ["rover: as the drawing says"], "notes": [], "mast_file": {"path": "m", "digest": "d"},
    },
}  # fmt: skip

HEAD = """
import json, os, signal, sys, threading, time
def tell(**event):
    print(json.dumps(event), flush=True)
def leave_with_answers():
    threading.Thread(target=hear, daemon=True).start()
def hear():
    for line in iter(sys.stdin.readline, ""):
        answers.append(line)
    os._exit(3)
answers = []
leave_with_answers()
def answered():
    while not answers:
        time.sleep(0.005)
    return answers.pop(0).strip()
"""


@dataclass
class FakeStops:
    """Stops and what runs, as far as the guide asks."""

    running: str | None = None
    reasons: list[str] = field(default_factory=list)
    confirms: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        self.confirms.set()

    def stop(self, reason: str = "") -> str | None:
        self.confirms.wait(NET_S)
        self.reasons.append(reason)
        was, self.running = self.running, None
        return was


@dataclass
class World:
    """A guide and what stands around it."""

    guide: Guide
    leases: LeaseTable
    publisher: Publisher
    stops: FakeStops
    masts: Path
    told: list[GuidedRun] = field(default_factory=list)
    lent: list[str] = field(default_factory=list)

    def begin(self, **wanted: Any) -> GuidedRun:
        return self.guide.start(RunRequest(**({"board": "charuco_a4"} | wanted)), "Ana")

    def until(self, state: str) -> GuidedRun:
        """The run, once it is in a state."""

        def there() -> GuidedRun | None:
            run = self.guide.run
            return run if run is not None and run.state == state else None

        run = until(there, f"the run is {state}; it is {self.guide.run}")
        assert run is not None
        return run

    @property
    def pid(self) -> int:
        work = self.guide._work
        assert work is not None and work.child is not None
        return work.child.pid


def lines(*events: Any) -> str:
    """A script that tells these."""
    return "".join(f"print({json.dumps(json.dumps(one))}, flush=True)\n" for one in events)


@contextmanager
def world(folder: Path, script: str, simulated: bool = True) -> Iterator[World]:
    """A guide whose program is a script of a test, after `HEAD`."""
    masts = folder / "masts"
    masts.mkdir(exist_ok=True)
    publisher, stops = Publisher(), FakeStops()
    leases = LeaseTable(
        SystemClock(),
        lambda: stops.running is not None,
        lambda control: publisher.publish("lease", "lease", None),
    )

    def command(run: GuidedFolder, asked: dict[str, Any], door: WayIn, mast_file: Path) -> Sequence[str]:
        body = f"MAST, REPORT = {str(mast_file)!r}, {str(run.report)!r}\n{script}"
        return [sys.executable, "-c", HEAD + body]

    lent: list[str] = []

    def lend(name: str) -> tuple[str, Any]:
        lent.append(name)
        return "secret-of-the-child", lambda: lent.remove(name)

    guide = Guide(folder / "state", lambda: masts, leases, stops, stops, publisher, simulated, command)
    (folder / "state").mkdir(exist_ok=True)
    guide.door = WayIn("http://127.0.0.1:1", lend)
    made = World(guide, leases, publisher, stops, masts, lent=lent)
    news = publisher.subscribe("bench")

    def listen() -> None:
        while not news.closed:
            made.told += [one.value for one in news.wait(0.5)]

    thread = threading.Thread(target=listen, daemon=True)
    thread.start()
    try:
        yield made
    finally:
        guide.close()
        publisher.close()
        thread.join(60.0)
