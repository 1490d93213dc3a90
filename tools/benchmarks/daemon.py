"""Measure a daemon in a process of its own: start and stops.

    .venv/bin/python -m tools.benchmarks.daemon start [--rounds 10]
    .venv/bin/python -m tools.benchmarks.daemon stop [--head memory|dynamixel|ptu] [--stops 100] [--crowd]

``start``: import, start until the first answer, and end; medians, in turn. The daemon has a simulated head
and no camera.

``stop``: the head is under way each time, four clients take ten images a second each, one client has stalled,
and no program reads the log. Stops arrive over HTTP, by a new connection each, and over the stop socket. An
emergency stop's answer says that the latch is on the disk. The last column is from the answer to the
operation's end. With ``--crowd`` there are also 60 clients that take a picture a second, 60 that listen to
events for a second and connect again, 30 that read the description each second, and 150 that read nothing.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from hil_tests.support.living_daemon import simulated, started
from mastctl.cli.options import at_least
from mastctl.client import Client, ClientError
from mastctl.packaged import default_config
from mastctl.safety.stop_socket import request
from tools.command import end, heading, line, options

HEADS = ("memory", "dynamixel", "ptu")
STREAMS = 4
CAMERA = "navcam_left"
NET_S = 300.0
FAR_RAD = 0.6

STREAM = """
import http.client, sys, time
there = http.client.HTTPConnection("127.0.0.1", int(sys.argv[1]))
due_s = time.monotonic()
while True:
    there.request("GET", "/api/v1/snapshot/%s?fresh=false&format=jpeg" % sys.argv[2])
    there.getresponse().read()
    due_s = max(due_s + 0.1, time.monotonic())
    time.sleep(max(0.0, due_s - time.monotonic()))
"""


CROWD = """
import asyncio, sys
async def ask(path, reads):
    while True:
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", int(sys.argv[1]))
            request_bytes = f"GET {path} HTTP/1.1\\r\\nHost: 127.0.0.1\\r\\n\\r\\n".encode()
            writer.write(request_bytes * (1 if reads else 20))
            await asyncio.wait_for(reader.read(), 1.0) if reads else await asyncio.sleep(3600.0)
        except (OSError, TimeoutError, asyncio.TimeoutError):
            pass
        writer.close()
async def main():
    snapshot = f"/api/v1/snapshot/{sys.argv[2]}?fresh=false"
    events, description = "/api/v1/events", "/openapi.json"
    rows = (60, snapshot, True), (60, events, True), (30, description, True), (150, snapshot, False)
    await asyncio.gather(*(ask(path, reads) for count, path, reads in rows for _ in range(count)))
asyncio.run(main())
"""


def main() -> int:
    """Measure and print a table."""
    parser = options(__doc__, seed=None, tasks=False)
    parser.add_argument("what", choices=("start", "stop"))
    parser.add_argument("--head", choices=HEADS, help="stop: one of them (default: all)")
    parser.add_argument("--stops", type=at_least(1), default=100, metavar="N", help="of each kind (100)")
    parser.add_argument("--crowd", action="store_true", help="stop: beside 300 clients more")
    parser.add_argument("--rounds", type=at_least(1), metavar="N", default=10, help="of start (10)")
    args = parser.parse_args()
    if args.what == "start":
        start(args.rounds)
    else:
        for head in [args.head] if args.head else HEADS:
            stops_under_way(head, args.stops, args.crowd)
    return 0


def start(rounds: int) -> None:
    """Print medians of processor time, with that of ended processes, and of time passed."""
    spent: dict[str, list[tuple[float, float]]] = defaultdict(list)

    @contextlib.contextmanager
    def spending(what: str) -> Iterator[None]:
        before, before_s = os.times(), time.monotonic()
        yield
        spent[what].append((sum(os.times()[:4]) - sum(before[:4]), time.monotonic() - before_s))

    with tempfile.TemporaryDirectory() as folder:
        config = simulated(Path(folder), "memory", ())
        for _ in range(rounds):
            with spending("import numpy, scipy, cv2, fastapi, uvicorn"):
                subprocess.run([sys.executable, "-c", LIBRARIES], check=True)
            with spending("import mastctl.daemon"):
                subprocess.run([sys.executable, "-c", "import mastctl.daemon"], check=True)
            with (
                spending("mastctl run, first answer, end"),
                started(config) as (_, port),
                Client(f"http://127.0.0.1:{port}") as client,
            ):
                client.status()
    print(heading(("median, s", "processor", "passed")))
    for what, times in spent.items():
        print(line(what, *(f"{one:.3f}" for one in np.median(times, axis=0))))


LIBRARIES = "import numpy, scipy.optimize, scipy.spatial, cv2, fastapi, uvicorn, httpx, websockets, yaml"


def stops_under_way(head: str, stops: int, crowd: bool) -> None:
    """Print how soon stops of a moving head are answered, and how soon the operation ends."""
    columns = ("head", "request", "answered, ms: median", "90 %", "99 %", "longest", "within 20 ms, %")
    print(heading((*columns, "ended: 99 %")))
    with (
        tempfile.TemporaryDirectory() as folder,
        _daemon(Path(folder), head) as (port, path),
        _streams(port, crowd),
        Client(f"http://127.0.0.1:{port}") as client,
    ):
        for name, stop in _requests(client.url, path).items():
            rows = [_stop_under_way(client, stop) for _ in range(stops)]
            answered_ms, ended_ms = 1e3 * np.array(rows).T
            cells = [*np.quantile(answered_ms, (0.5, 0.9, 0.99, 1.0)), 100.0 * np.mean(answered_ms <= 20.0)]
            print(line(head, name, *(f"{one:.1f}" for one in (*cells, np.quantile(ended_ms, 0.99)))))


def _requests(url: str, path: Path) -> dict[str, Callable[[], Any]]:
    """Return each kind of stop as a function."""

    def once(call: Callable[[Client], Any]) -> Any:
        with Client(url, name="benchmark") as client:
            return call(client)

    return {
        "stop, HTTP": lambda: once(lambda client: client.stop()),
        "stop, socket": lambda: request(path, "stop"),
        "estop, HTTP": lambda: once(lambda client: client.estop()),
        "estop, socket": lambda: request(path, "estop benchmark: a measurement"),
    }


def _stop_under_way(client: Client, stop: Callable[[], Any]) -> tuple[float, float]:
    """Send the head off, stop it under way; return how long the answer took, and from it the end."""
    status = _until(client, lambda status: status["state"] not in ("stopping", "moving", "starting"))
    away = -1.0 if status["joints"]["pan_rad"] > 0 else 1.0
    client.point(pan_rad=away * FAR_RAD, tilt_rad=-0.2)
    _until(client, lambda status: status["moving"])
    began_s = time.monotonic()
    answer = stop()
    answered_s = time.monotonic()
    if answer.get("kept") is False:
        raise RuntimeError(f"the latch is not kept: {answer}")
    status = _until(client, lambda status: status["operation"] is None)
    ended_s = time.monotonic()
    while status["estop"] is not None:
        with contextlib.suppress(ClientError):  # while the stop is not over
            client.reset(reason="a measurement", name="benchmark")
        status = client.status()
    return answered_s - began_s, ended_s - answered_s


@contextlib.contextmanager
def _daemon(folder: Path, head: str) -> Iterator[tuple[int, Path]]:
    """Run a daemon whose log no program reads: its port and its stop socket."""
    config = simulated(folder, head, tuple(yaml.safe_load(default_config().read_text())["cameras"]))
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(writing, b"\n" * 4096)
    os.set_blocking(writing, True)
    command = [sys.executable, "-m", "mastctl", "run", "--config", str(config)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=writing, text=True) as daemon:
        try:
            assert daemon.stdout is not None
            url = daemon.stdout.readline().strip()
            if not url:
                raise RuntimeError("the daemon did not start; its log was blocked on purpose")
            yield int(url.rpartition(":")[2]), folder / "state" / "stop.sock"
        finally:
            daemon.kill()
            os.close(reading)
            os.close(writing)


@contextlib.contextmanager
def _streams(port: int, crowd: bool) -> Iterator[None]:
    """Clients that stream pictures, perhaps a crowd, and one that requests many and reads none."""
    streams = [
        subprocess.Popen([sys.executable, "-c", script, str(port), CAMERA], stderr=subprocess.DEVNULL)
        for script in [STREAM] * STREAMS + [CROWD] * crowd
    ]
    stalled = socket.create_connection(("127.0.0.1", port))
    stalled.setblocking(False)
    request = f"GET /api/v1/snapshot/{CAMERA}?fresh=false&format=png HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    stalled.send(request.encode() * 20)
    try:
        time.sleep(2.0)
        yield
    finally:
        stalled.close()
        for stream in streams:
            stream.kill()
            stream.wait()


def _until(client: Client, holds: Callable[[Any], bool]) -> Any:
    """The first status of which something holds."""
    until_s = time.monotonic() + NET_S
    while time.monotonic() < until_s:
        if holds(status := client.status()):
            return status
        time.sleep(0.002)
    raise TimeoutError("the awaited state did not come")


if __name__ == "__main__":
    end(main)
