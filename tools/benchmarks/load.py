"""What a daemon costs at rest, and what many clients cost a pointing.

    python -m tools.benchmarks.load [--seconds N] [--pointings N] [--rounds N] [--only idle|busy]

*Idle*: a daemon with a real head driver whose servos are simulated in this process, so that only the daemon's
own time counts, as the kernel tells it (``/proc/PID/stat``); with nobody, and with one client that reads the
status once a second. Wanted: below 2 % of a core.

*Busy*: the simulated rover points at two places by turns, alone and beside 50 clients that read the status
ten times a second and 4 that take ten pictures a second, blocks by turns in one run. The clients are one
process more. Told are the medians of the whole operation and of each of its steps, and their ratio. Wanted:
at most 1.1.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from mastctl.cli.output import at_least, positive_number
from mastctl.packaged import default_config
from tools.campaigns.servo_rigs import line_alone
from tools.command import end
from tools.living_daemon import Asker, simulated, started, vitals, written

CLIENTS, STREAMS = 50, 4
STATUS_S, PICTURE_S = 0.1, 0.1
CAMERAS = ("navcam_left", "navcam_right")
PLACES_M = ([6.0, 0.4, 0.0], [6.0, -0.4, 0.0])
WHOLE = "the whole"
SETTLE_S = 3.0
ENDS_S = 120.0
DRIVERS = ("dynamixel", "flir_ptu")


def main() -> int:
    """Measure and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "--seconds", type=positive_number, default=60.0, metavar="N", help="idle (default 60)"
    )
    parser.add_argument("--pointings", type=at_least(1), default=6, metavar="N", help="a block (default 6)")
    parser.add_argument(
        "--rounds", type=at_least(1), default=4, metavar="N", help="of two blocks (default 4)"
    )
    parser.add_argument("--only", choices=["idle", "busy"], help="one of the two (default: both)")
    parser.add_argument("--clients", type=int, metavar="PORT", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.clients is not None:
        asyncio.run(_clients(args.clients))
        return 0
    if args.only != "busy":
        for driver in DRIVERS:
            idle(driver, args.seconds)
    if args.only != "idle":
        busy(args.pointings, args.rounds)
    return 0


def idle(driver: str, duration_s: float) -> dict[str, float]:
    """Print and return what a daemon at rest costs, percent of a core, by who looks."""
    costs: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as name, line_alone(driver) as (options, _):
        config = _on_line(Path(name), driver, options)
        with started(config) as (daemon, port):
            time.sleep(SETTLE_S)
            for who, look in (("nobody", _nobody), ("a client, 1 Hz", _one_client)):
                before_s, began_s = vitals(daemon.pid).cpu_s, time.monotonic()
                look(port, duration_s)
                costs[who] = _cost(daemon.pid, before_s, began_s)
                load = os.getloadavg()[0]
                print(
                    f"idle, {driver:<10} {who:<16} {costs[who]:6.2f} % of a core   load {load:.1f}",
                    flush=True,
                )
    return costs


def _cost(pid: int, before_s: float, began_s: float) -> float:
    """What a process has cost since, percent of a core."""
    return 100 * (vitals(pid).cpu_s - before_s) / (time.monotonic() - began_s)


def _on_line(folder: Path, driver: str, options: dict[str, Any]) -> Path:
    """A daemon of a head alone."""
    home = default_config().resolve().parent
    mast_file = yaml.safe_load(default_config().read_text())["mast_file"]
    return written(
        folder,
        {
            "schema": "mastctl/config/1",
            "mast_file": str(home / mast_file),
            "listen": {"port": 0},
            "pan_tilt": {"driver": driver, "options": options},
            "limits": {"pan_rad": [-0.9, 0.9], "tilt_rad": [-0.5, 0.35], "speed_rad_per_s": 0.5},
            "state": {"folder": str(folder / "state")},
        },
    )


def _nobody(port: int, duration_s: float) -> None:
    time.sleep(duration_s)


def _one_client(port: int, duration_s: float) -> None:
    until_s = time.monotonic() + duration_s
    with Asker(port, "load") as asker:
        while time.monotonic() < until_s:
            asker.json("GET", "/status")
            time.sleep(1.0)


def busy(pointings: int, rounds: int) -> float:
    """Print what the clients cost a pointing; return the ratio of the whole operations' medians."""
    times: dict[bool, dict[str, list[float]]] = {False: defaultdict(list), True: defaultdict(list)}
    costs: dict[bool, list[float]] = {False: [], True: []}
    answered: list[float] = []
    with tempfile.TemporaryDirectory() as name:
        config = simulated(Path(name), "memory", CAMERAS)
        with started(config) as (daemon, port), Asker(port, "load") as asker:
            for place in PLACES_M:
                _point(asker, place)  # what is drawn first takes longer
            for _ in range(rounds):
                for loaded in (False, True):
                    with _load(port, answered) if loaded else contextlib.nullcontext():
                        before_s, began_s = vitals(daemon.pid).cpu_s, time.monotonic()
                        for number in range(pointings):
                            record = _point(asker, PLACES_M[number % 2])
                            times[loaded][WHOLE].append(record["ended_s"] - record["created_s"])
                            for step in record["steps"]:
                                times[loaded][step["name"]].append(step["duration_s"])
                        costs[loaded].append(_cost(daemon.pid, before_s, began_s))
    alone, beside = (statistics.median(costs[loaded]) for loaded in (False, True))
    print(
        f"busy: {CLIENTS} clients at {1 / STATUS_S:g} Hz, {STREAMS} streams at {1 / PICTURE_S:g} Hz: "
        f"{statistics.median(answered):.0f} answers a second; load {os.getloadavg()[0]:.1f}; the daemon used "
        f"{alone:.0f} % of a core alone, {beside:.0f} % beside them"
    )
    print("step                  alone ms   beside clients ms   ratio")
    ratios = {}
    for step in times[False]:
        alone, beside = (1e3 * statistics.median(times[loaded][step]) for loaded in (False, True))
        ratios[step] = beside / alone if alone else 1.0
        print(f"{step:<20} {alone:9.1f} {beside:19.1f} {ratios[step]:7.2f}")
    return ratios[WHOLE]


def _point(asker: Asker, place_m: list[float]) -> dict[str, Any]:
    """Point at a place and return the operation's record when it has ended."""
    asked = asker.json("POST", "/point", {"position_m": place_m, "frame": "rover"})
    until_s = time.monotonic() + ENDS_S
    while time.monotonic() < until_s:
        record = asker.json("GET", f"/operations/{asked['id']}")
        if record["state"] == "done":
            return record
        if record["state"] in ("failed", "stopped"):
            raise RuntimeError(f"the pointing ended as {record['state']}: {record['error']}")
        time.sleep(0.05)
    raise TimeoutError(f"the pointing did not end within {ENDS_S:g} s")


@contextlib.contextmanager
def _load(port: int, answered: list[float]) -> Iterator[None]:
    """All clients, in a process of their own; notes how many answers a second they got."""
    command = [sys.executable, "-m", "tools.benchmarks.load", "--clients", str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as clients:
        try:
            time.sleep(SETTLE_S)
            yield
        finally:
            clients.terminate()
            assert clients.stdout is not None
            answered.append(float(clients.stdout.read()))


async def _clients(port: int) -> None:
    """Ask until this process is ended, and print how many answers a second there were."""
    status = b"GET /api/v1/status HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    picture = b"GET /api/v1/snapshot/%s?fresh=false&format=jpeg HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    asked = [(status, STATUS_S)] * CLIENTS
    asked += [(picture % CAMERAS[number % len(CAMERAS)].encode(), PICTURE_S) for number in range(STREAMS)]
    answers = [0]
    began_s = time.monotonic()
    everybody = asyncio.gather(*(_ask(port, request, period_s, answers) for request, period_s in asked))
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, everybody.cancel)
    with contextlib.suppress(asyncio.CancelledError):
        await everybody
    print(answers[0] / (time.monotonic() - began_s))


async def _ask(port: int, request: bytes, period_s: float, answers: list[int]) -> None:
    """Ask again and again on one connection, at most so often."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    while True:
        due_s = time.monotonic() + period_s
        writer.write(request)
        head = await reader.readuntil(b"\r\n\r\n")
        length = next(
            int(line.partition(b":")[2])
            for line in head.split(b"\r\n")
            if line.lower().startswith(b"content-length:")
        )
        await reader.readexactly(length)
        answers[0] += 1
        await asyncio.sleep(max(0.0, due_s - time.monotonic()))


if __name__ == "__main__":
    end(main)
