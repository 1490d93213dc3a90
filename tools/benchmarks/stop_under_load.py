"""How soon a stop is answered while four clients stream pictures, one has stalled, and nobody reads the log.

Each of the four takes ten pictures a second.

    python -m tools.benchmarks.stop_under_load [--stops N] [--head memory|ptu|dynamixel]
    python -m tools.benchmarks.stop_under_load --beside [CROWD ...] [--code FOLDER ...] [--rounds N]

The daemon is a process of its own on the simulated rover, its head in memory or behind the bytes of a PTU or
of Dynamixel servos. Each stop finds the head under way. `stop` and `estop` are asked over HTTP, by a new
connection each, and over the stop socket; an emergency stop's answer has the latch on the disk (``kept``).
The last column is from the answer to the end of the operation as the status tells it.

``--beside`` measures stops of a head at rest beside crowds that ask for what costs much: 60 clients for a
kept frame as PNG, 60 that connect to the events again and again, 30 for the description, 150 that ask for
events and read none; and beside nobody, as the control. ``--code`` names checkouts whose daemons are
compared, in turn in each round; the last column but one is how often a second the crowd was answered.
"""

from __future__ import annotations

import contextlib
import http.client
import json
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

import yaml

from mastctl.cli.output import at_least
from mastctl.config import load_config
from mastctl.packaged import default_config
from mastctl.safety.stop_line import ask
from tools.benchmarks.crowd import LOADS
from tools.command import end, options

HEADS = {"memory": None, "ptu": "flir_ptu", "dynamixel": "dynamixel"}
STREAMS = 4
CAMERA = "navcam_left"
STARTED_S = 300.0
FAR_RAD = 0.6
SETTLE_S = 3.0
APART_S = 0.03

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
    parser.add_argument(
        "--stops", type=at_least(1), default=100, metavar="N", help="of each kind (default 100)"
    )
    parser.add_argument("--head", choices=sorted(HEADS), help="one of them (default: all)")
    parser.add_argument(
        "--beside", nargs="*", choices=sorted(LOADS), metavar="CROWD", help=f"{', '.join(LOADS)} (all)"
    )
    parser.add_argument(
        "--code", nargs="+", type=Path, default=[Path.cwd()], metavar="FOLDER", help="checkouts (this one)"
    )
    parser.add_argument("--rounds", type=at_least(1), default=1, metavar="N", help="of all crowds (1)")
    args = parser.parse_args()
    if args.beside is not None:
        beside_crowds(args.beside or list(LOADS), args.code, args.stops, args.rounds)
        return 0
    print(
        "head       asked             answered ms: median   90 %   99 %  longest   within 20 ms   ended: 99 %"
    )
    for head in [args.head] if args.head else HEADS:
        with (
            tempfile.TemporaryDirectory() as folder,
            _daemon(Path(folder), head) as (port, path),
            _load(port),
        ):
            for name, stop in _ways(port, path).items():
                rows = [_one(port, stop) for _ in range(args.stops)]
                answered, ended = (sorted(1e3 * row[number] for row in rows) for number in (0, 1))
                within = sum(one <= 20.0 for one in answered) / len(answered)
                print(
                    f"{head:<10} {name:<18} {_part(answered, 0.5):>18.1f} {_part(answered, 0.9):>6.1f}"
                    f" {_part(answered, 0.99):>6.1f} {answered[-1]:>8.1f} {100 * within:>12.1f} %"
                    f" {_part(ended, 0.99):>15.1f}",
                    flush=True,
                )
    return 0


def beside_crowds(crowds: list[str], checkouts: list[Path], stops: int, rounds: int) -> None:
    """Print how soon stops were answered beside each crowd, by the daemon of each checkout."""
    found: dict[tuple[str, Path, str], list[float]] = defaultdict(list)
    answered: dict[tuple[str, Path], list[float]] = defaultdict(list)
    for _ in range(rounds):
        for code in checkouts:
            for crowd in ("nobody", *crowds):  # a daemon of its own for each, as after a start
                with (
                    tempfile.TemporaryDirectory() as folder,
                    _daemon(Path(folder), "memory", code) as (port, path),
                    _crowd(crowd, port, answered[crowd, code]),
                ):
                    ways = _ways(port, path)
                    for number in range(2 * stops):
                        name = ("stop, HTTP", "stop, socket")[number % 2]
                        began_s = time.monotonic()
                        ways[name]()
                        found[crowd, code, name].append(1e3 * (time.monotonic() - began_s))
                        time.sleep(APART_S)
    print(f"{'beside':<12} {'asked':<13} answered ms: median   99 %   worst   within 20 ms   crowd/s   code")
    for (crowd, code, name), times_ms in sorted(found.items()):
        ordered = sorted(times_ms)
        within = sum(one <= 20.0 for one in ordered) / len(ordered)
        rate = sum(answered[crowd, code]) / len(answered[crowd, code])
        print(
            f"{crowd:<12} {name:<13} {_part(ordered, 0.5):>19.1f} {_part(ordered, 0.99):>6.1f}"
            f" {ordered[-1]:>7.1f} {100 * within:>12.1f} % {rate:>9.1f}   {code}",
            flush=True,
        )


@contextlib.contextmanager
def _crowd(name: str, port: int, answered: list[float]) -> Iterator[None]:
    """A crowd at work in a process of its own; ``nobody`` is none. Notes its answers a second."""
    _get(port, "/status")
    if name == "nobody":
        answered.append(0.0)
        yield
        return
    command = [sys.executable, "-m", "tools.benchmarks.crowd", name, str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as crowd:
        began_s = time.monotonic()
        try:
            time.sleep(SETTLE_S)
            yield
        finally:
            crowd.terminate()
        answered.append(float(crowd.communicate()[0]) / (time.monotonic() - began_s))


def _part(ordered: list[float], part: float) -> float:
    """The value that this part of them does not exceed."""
    return ordered[min(len(ordered) - 1, int(part * len(ordered)))]


def _ways(port: int, path: Path) -> dict[str, Callable[[], object]]:
    """The ways to ask."""
    return {
        "stop, HTTP": lambda: _post(port, "/stop"),
        "stop, socket": lambda: ask(path, "stop"),
        "estop, HTTP": lambda: _kept(_post(port, "/estop", {"name": "benchmark"})),
        "estop, socket": lambda: _kept(ask(path, "estop benchmark: a measurement")),
    }


def _kept(told: dict[str, Any]) -> None:
    if told["kept"] is not True:
        raise RuntimeError(f"the latch is not kept: {told}")


def _one(port: int, stop: Callable[[], object]) -> tuple[float, float]:
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
        while _post(port, "/reset", {"reason": "a measurement", "name": "benchmark"}, good=False) != 200:
            time.sleep(0.01)
    return answered_s - began_s, ended_s - answered_s


@contextlib.contextmanager
def _daemon(folder: Path, head: str, code: Path | None = None) -> Iterator[tuple[int, Path]]:
    """A daemon of a checkout (this one) whose log nobody reads: its port and its stop socket."""
    packaged = default_config()
    document = yaml.safe_load(packaged.read_text())
    document["listen"] = {"port": 0}
    home = packaged.resolve().parent
    document["mast_file"] = str(home / document["mast_file"])
    document["simulation"]["rover"] = str(home / document["simulation"]["rover"])
    document["state"] = {"folder": str(folder / "state")}
    if HEADS[head] is not None:
        document["simulation"]["wire"] = HEADS[head]
        del document["simulation"]["head"]  # the wire's own
    config = folder / "rover.yaml"
    config.write_text(yaml.safe_dump(document))
    load_config(config)  # refused here it is told
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(writing, b"\n" * 4096)
    os.set_blocking(writing, True)
    command = [sys.executable, "-m", "mastctl", "run", "--config", str(config)]
    there = (code or Path.cwd()).resolve()
    ours = {**os.environ, "PYTHONPATH": str(there)}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=writing, text=True, cwd=there, env=ours
    ) as daemon:
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
def _load(port: int) -> Iterator[None]:
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
    until_s = time.monotonic() + STARTED_S
    while time.monotonic() < until_s:
        status = _get(port, "/status")
        if holds(status):
            return status
        time.sleep(0.002)
    raise TimeoutError("what must come did not come")


def _get(port: int, path: str) -> dict[str, Any]:
    told: dict[str, Any] = json.loads(_asked(port, "GET", path, None)[1])
    return told


def _post(port: int, path: str, body: dict[str, Any] | None = None, good: bool = True) -> Any:
    status, data = _asked(port, "POST", path, body)
    if not good:
        return status
    if status not in (200, 202):
        raise RuntimeError(f"POST {path}: {status} {data.decode()}")
    return json.loads(data)


def _asked(port: int, method: str, path: str, body: dict[str, Any] | None) -> tuple[int, bytes]:
    there = http.client.HTTPConnection("127.0.0.1", port, timeout=30.0)
    try:
        data = None if body is None else json.dumps(body)
        headers = {} if body is None else {"Content-Type": "application/json"}
        there.request(method, f"/api/v1{path}", data, headers)
        answer = there.getresponse()
        return answer.status, answer.read()
    finally:
        there.close()


if __name__ == "__main__":
    end(main)
