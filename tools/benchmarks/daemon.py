"""Measure a daemon in a process of its own: start and stops.

    .venv/bin/python -m tools.benchmarks.daemon start [--rounds 10]
    .venv/bin/python -m tools.benchmarks.daemon stop [--head memory|dynamixel|ptu] [--stops 100]

``start``: import, start until the first answer, and end; medians, in turn. The daemon has a simulated head
and no camera.

``stop``: the head is under way each time, four clients take ten images a second each, one client has stalled,
and no program reads the log. Stops arrive over HTTP, by a new connection each, and over the stop socket. An
emergency stop's answer says that the latch is on the disk. The last column is from the answer to the
operation's end.
"""

from __future__ import annotations

import contextlib
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import yaml

from hil_tests.support.living_daemon import Asker, simulated, started
from mastctl.cli.output import at_least
from mastctl.packaged import default_config
from mastctl.safety.stop_line import ask
from tools.command import end, options

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


def main() -> int:
    """Measure and print a table."""
    parser = options(__doc__, seed=None, tasks=False)
    parser.add_argument("what", choices=("start", "stop"))
    parser.add_argument("--head", choices=HEADS, help="stop: one of them (default: all)")
    parser.add_argument("--stops", type=at_least(1), default=100, metavar="N", help="of each kind (100)")
    parser.add_argument("--rounds", type=at_least(1), metavar="N", default=10, help="of start (10)")
    args = parser.parse_args()
    if args.what == "start":
        start(args.rounds)
    else:
        for head in [args.head] if args.head else HEADS:
            stops_under_way(head, args.stops)
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
            with spending("mastctl run, first answer, end"), started(config) as (_, port):
                _get(port, "/health/live")
    print(f"{'seconds, median':44s} processor   passed")
    for what, times in spent.items():
        processor_s, passed_s = (statistics.median(one) for one in zip(*times, strict=True))
        print(f"{what:44s} {processor_s:9.3f} {passed_s:8.3f}")


LIBRARIES = "import numpy, scipy.optimize, scipy.spatial, cv2, fastapi, uvicorn, httpx, websockets, yaml"


def stops_under_way(head: str, stops: int) -> None:
    """Print how soon stops of a moving head are answered, and how soon the operation ends."""
    print(
        "head       request           answered ms: median   90 %   99 %  longest   within 20 ms   ended: 99 %"
    )
    with tempfile.TemporaryDirectory() as folder, _daemon(Path(folder), head) as (port, path), _streams(port):
        for name, stop in _requests(port, path).items():
            rows = [_stop_under_way(port, stop) for _ in range(stops)]
            answered, ended = (sorted(1e3 * row[number] for row in rows) for number in (0, 1))
            within = sum(one <= 20.0 for one in answered) / len(answered)
            print(
                f"{head:<10} {name:<18} {_part(answered, 0.5):>18.1f} {_part(answered, 0.9):>6.1f}"
                f" {_part(answered, 0.99):>6.1f} {answered[-1]:>8.1f} {100 * within:>12.1f} %"
                f" {_part(ended, 0.99):>15.1f}",
                flush=True,
            )


def _part(ordered: list[float], part: float) -> float:
    """The value that this part of them does not exceed."""
    return ordered[min(len(ordered) - 1, int(part * len(ordered)))]


def _requests(port: int, path: Path) -> dict[str, Callable[[], object]]:
    """Return each kind of stop as a function."""
    return {
        "stop, HTTP": lambda: _post(port, "/stop"),
        "stop, socket": lambda: ask(path, "stop"),
        "estop, HTTP": lambda: _kept(_post(port, "/estop", {"name": "benchmark"})),
        "estop, socket": lambda: _kept(ask(path, "estop benchmark: a measurement")),
    }


def _kept(answer: dict[str, Any]) -> None:
    if answer["kept"] is not True:
        raise RuntimeError(f"the latch is not kept: {answer}")


def _stop_under_way(port: int, stop: Callable[[], object]) -> tuple[float, float]:
    """Send the head off, stop it under way; return how long the answer took, and from it the end."""
    pan = _get(port, "/status")["joints"]["pan_rad"]
    _until(port, lambda status: status["state"] not in ("stopping", "moving", "starting"))
    _post(port, "/point", {"pan_rad": FAR_RAD if pan < 0 else -FAR_RAD, "tilt_rad": -0.2})
    _until(port, lambda status: status["moving"])
    began_s = time.monotonic()
    stop()
    answered_s = time.monotonic()
    status = _until(port, lambda status: status["operation"] is None)
    ended_s = time.monotonic()
    if status["estop"] is not None:
        with Asker(port, "benchmark") as asker:
            body = {"reason": "a measurement", "name": "benchmark"}
            while asker.ask("POST", "/reset", body)[0] != 200:
                time.sleep(0.01)
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
def _streams(port: int) -> Iterator[None]:
    """Clients that stream pictures, and one that asks for many and reads none."""
    _get(port, "/status")
    streams = [
        subprocess.Popen([sys.executable, "-c", STREAM, str(port), CAMERA], stderr=subprocess.DEVNULL)
        for _ in range(STREAMS)
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


def _until(port: int, holds: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """The first status of which something holds."""
    until_s = time.monotonic() + NET_S
    while time.monotonic() < until_s:
        status = _get(port, "/status")
        if holds(status):
            return status
        time.sleep(0.002)
    raise TimeoutError("the awaited state did not come")


def _get(port: int, path: str) -> dict[str, Any]:
    with Asker(port, "benchmark") as asker:
        return asker.json("GET", path)


def _post(port: int, path: str, body: dict[str, Any] | None = None) -> dict[str, Any]:
    with Asker(port, "benchmark") as asker:
        return asker.json("POST", path, body)


if __name__ == "__main__":
    end(main)
