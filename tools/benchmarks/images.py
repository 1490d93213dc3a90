"""Live pictures of a simulated pair of 1024x768 at rest: frames a second, their age, the daemon's load.

Then what watching costs an operation on a rover at full speed (``simulation.speed: max``): a turn of the
head, and a picture of each camera.

.venv/bin/python -m tools.benchmarks.images [--seconds 10] [--rate 30] [--rounds 4]
"""

from __future__ import annotations

import json
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import yaml
from websockets.sync.client import connect

from mastctl.client import Client
from tools.command import end, options
from tools.living_daemon import Asker, simulated, started, vitals, written

PAIR = ("navcam_left", "navcam_right")
TURNS = 5


def main() -> int:
    """Watch, and print a line for each camera and one for the daemon."""
    parser = options(__doc__, seed=None, tasks=False)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rate", type=float, default=30.0, help="of the cameras, Hz")
    parser.add_argument("--rounds", type=int, default=4, help="of operations, unwatched and watched in turns")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        config = simulated(Path(folder), "memory", PAIR)
        document = yaml.safe_load(config.read_text())
        document["simulation"]["cameras"] = {"rate_hz": asked.rate}
        written(Path(folder), document)
        with started(config) as (daemon, port), Asker(port, "benchmark") as asker:
            for name in PAIR:
                asker.ask("GET", f"/snapshot/{name}?fresh=true")
            watch(daemon.pid, port, asked.seconds)
        document["simulation"]["speed"] = "max"
        written(Path(folder), document)
        with started(config) as (_, port):
            operations(port, asked.rounds)
    return 0


def watch(pid: int, port: int, seconds: float) -> None:
    """Take pictures for some time, each acknowledged when it is here."""
    ages_s: dict[str, list[float]] = {name: [] for name in PAIR}
    sizes: list[int] = []
    query = "&".join(f"camera={name}" for name in PAIR)
    with connect(f"ws://127.0.0.1:{port}/api/v1/images?{query}", proxy=None, max_size=None) as line:
        line.recv()
        line.send(PAIR[0])
        before, began_s = vitals(pid).cpu_s, time.monotonic()
        while time.monotonic() - began_s < seconds:
            message = line.recv(timeout=10.0)
            assert isinstance(message, bytes)
            length = int.from_bytes(message[:4], "little")
            facts = json.loads(message[4 : 4 + length])
            ages_s[facts["camera"]].append(time.monotonic() - facts["mid_exposure_s"])
            sizes.append(len(message))
            line.send(facts["camera"])
        took_s = time.monotonic() - began_s
        used = (vitals(pid).cpu_s - before) / took_s
    for name, ages in ages_s.items():
        told = np.array(ages) * 1e3
        print(
            f"{name}: {len(ages) / took_s:.1f} frames/s, glass to client median {np.median(told):.0f} ms, "
            f"99 % {np.percentile(told, 99):.0f} ms"
        )
    print(f"daemon: {100 * used:.0f} % of a core, {np.mean(sizes) / 1e3:.0f} kB a picture")


def operations(port: int, rounds: int) -> None:
    """Turn the head and take pictures, unwatched and watched in turns."""
    took_s: dict[str, list[float]] = {"unwatched": [], "watched": []}
    with Client(f"http://127.0.0.1:{port}", name="benchmark") as client:
        operate(client)
        for _ in range(rounds):
            took_s["unwatched"] += operate(client)
            with watched(port):
                took_s["watched"] += operate(client)
    for how, times in took_s.items():
        print(f"{how}: an operation at full speed takes {np.mean(times):.3f} s, at most {max(times):.3f} s")
    print(f"watched, unwatched: {np.mean(took_s['watched']) / np.mean(took_s['unwatched']):.2f} to 1")


def operate(client: Client) -> list[float]:
    """How long each of some operations takes, seconds."""
    took_s = []
    for k in range(TURNS):
        began_s = time.monotonic()
        client.wait(client.point(pan_rad=0.5 - (k % 2), tilt_rad=-0.2), timeout_s=120.0)
        for name in PAIR:
            client.snapshot(name)
        took_s.append(time.monotonic() - began_s)
    return took_s


@contextmanager
def watched(port: int) -> Iterator[None]:
    """Somebody watches both cameras, as quick as pictures come."""
    query = "&".join(f"camera={name}" for name in PAIR)
    over = threading.Event()
    with connect(f"ws://127.0.0.1:{port}/api/v1/images?{query}", proxy=None, max_size=None) as line:

        def show() -> None:
            while not over.is_set():
                try:
                    message = line.recv(timeout=0.5)
                except TimeoutError:
                    continue
                assert isinstance(message, bytes)
                length = int.from_bytes(message[:4], "little")
                line.send(json.loads(message[4 : 4 + length])["camera"])

        shows = threading.Thread(target=show)
        shows.start()
        try:
            time.sleep(1.0)
            yield
        finally:
            over.set()
            shows.join()


if __name__ == "__main__":
    end(main)
