"""Bench operations without a daemon: real leases, publisher and folders; a worker of the test's own."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from drivers.clock import SystemClock
from hil_tests.waiting import NET_S, until
from mastctl.answers import BenchRunRecord
from mastctl.bench.operation import BenchOperation
from mastctl.bench.runs import HOLDER, BenchJob
from mastctl.control.lease import LeaseTable
from mastctl.control.publisher import Publisher

BEGUN = {
    "board_m": [0.55, 0.33],
    "cameras": {"navcam_left": {"size_px": [1024, 768], "cells": [0] * 48}},
}
PLACE = {
    "requested": {
        "name": "p1", "range_m": 1.1, "bearing_deg": 0.0, "height_deg": 0.0, "turned_deg": [20.0, 0.0],
        "description": "straight ahead", "needs_confirmation": True,
    },
    "placements": 1, "step": "place", "state": "waiting",
}  # fmt: skip
PROGRESS = {
    "state": "running", "step": "pictures", "pictures": 3, "predicted_px": 6.2, "target_px": 0.2,
    "counts_px": 0.03, "next_rad": [0.3, -0.1], "expected_px": 3.7, "curve": [[3.0, 6.2]],
    "cameras": {"navcam_left": {"size_px": [1024, 768], "cells": [2] * 48}},
}  # fmt: skip
DONE = {
    "state": "done", "step": "over", "sentence": "verdict: trust it", "pictures": 18,
    "result": {
        "verdict": {
            "grade": "good", "words": "trust it", "reasons": [{"grade": "good", "sentence": "all well"}],
        },
        "rms_px": {"navcam_left": [0.05, 0.06]}, "check_rms_px": {"navcam_left": [0.07, 0.08]},
        "check": {
            "promised_px": {"navcam_left": 0.09}, "pointings": [], "pointing_rms_px": [0.1, 0.2],
            "pointing_promised_px": 0.15,
        },
        "calibrated_px": 0.1, "counts_px": 0.03, "pictures": 18, "placements": 2,
    },
}  # fmt: skip

Step = Mapping[str, Any] | Callable[[BenchJob, Connection], Mapping[str, Any]]


@dataclass(frozen=True)
class Script:
    """A worker: each step is what changes of the run, or a function of this or a test's module."""

    steps: tuple[Step, ...]

    def __call__(self, job: BenchJob, link: Connection) -> None:
        run: Mapping[str, Any] = job.run
        for step in self.steps:
            run = {**run, **(step(job, link) if callable(step) else step)}
            link.send(run)


def script(*steps: Step) -> Script:
    return Script(steps)


def answered(job: BenchJob, link: Connection) -> Mapping[str, Any]:
    """Wait for an answer, or for the daemon's end."""
    try:
        assert link.recv() is True
    except EOFError:
        os._exit(1)
    return {"state": "running", "step": "search"}


def killed(job: BenchJob, link: Connection) -> Mapping[str, Any]:
    os.kill(os.getpid(), signal.SIGKILL)
    return {}


def gives_up(job: BenchJob, link: Connection) -> Mapping[str, Any]:
    os._exit(7)


def says_lease_and_token(job: BenchJob, link: Connection) -> Mapping[str, Any]:
    return {"sentences": [f"{job.token} {job.lease_id}"]}


def says_folder(job: BenchJob, link: Connection) -> Mapping[str, Any]:
    return {"sentences": [job.folder.name]}


def writes_files(job: BenchJob, link: Connection) -> Mapping[str, Any]:
    """Leave a mast file, if there is one to copy, and a report."""
    for one in job.out.parent.glob("little.yaml"):
        shutil.copy(one, job.out)
    job.folder.page.parent.mkdir()
    page = "<title>Bench</title><h1>Residuals</h1><script>document.title = 1</script>"
    job.folder.page.write_text(page)
    return {}


def worker_pid() -> int | None:
    """The process of the worker, if one is at work."""
    return next((child.pid for child in multiprocessing.active_children() if child.name == HOLDER), None)


@dataclass
class FakeStops:
    """A head with what moves it, as far as leases stop it."""

    running: str | None = None
    reasons: list[str] = field(default_factory=list)

    def stop(self, reason: str = "") -> str | None:
        self.reasons.append(reason)
        was, self.running = self.running, None
        return was


@dataclass
class World:
    """An operation and its surroundings."""

    bench: BenchOperation
    leases: LeaseTable
    publisher: Publisher
    stops: FakeStops
    masts: Path
    published: list[BenchRunRecord] = field(default_factory=list)
    lent: list[str] = field(default_factory=list)

    @property
    def lease_id(self) -> str:
        lease = self.leases._lease
        assert lease is not None
        return lease.id

    def begin(self, **wanted: Any) -> BenchRunRecord:
        return self.bench.start("Ana", **({"board": "charuco_a4"} | wanted))

    def until(self, state: str) -> BenchRunRecord:
        """The run, once it is in a state."""

        def there() -> BenchRunRecord | None:
            run = self.bench.run
            return run if run is not None and run["state"] == state else None

        run = until(there, f"the run is {state}; it is {self.bench.run}")
        assert run is not None
        return run


@contextmanager
def world(folder: Path, work: Script, simulated: bool = True) -> Iterator[World]:
    """An operation whose worker is a script."""
    masts = folder / "masts"
    masts.mkdir(exist_ok=True)
    (folder / "state").mkdir(exist_ok=True)
    publisher, stops = Publisher(), FakeStops()
    leases = LeaseTable(
        SystemClock(),
        lambda: stops.running is not None,
        lambda: publisher.publish("lease", "lease", None),
        stops.stop,
    )
    bench = BenchOperation(folder / "state", lambda: masts, leases, publisher, simulated, work)
    lent: list[str] = []

    def lend(name: str) -> tuple[str, Callable[[], None]]:
        lent.append(name)
        return "secret-of-the-worker", lambda: lent.remove(name)

    bench.serve("http://127.0.0.1:1", lend)
    made = World(bench, leases, publisher, stops, masts, lent=lent)
    news = publisher.subscribe("bench")

    def listen() -> None:
        while not news.closed:
            made.published += [one.value for one in news.wait(0.5)]

    thread = threading.Thread(target=listen, daemon=True)
    thread.start()
    try:
        yield made
    finally:
        bench.close()
        publisher.close()
        thread.join(NET_S)
