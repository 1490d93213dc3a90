"""What the always-on ring costs, and a live view that nobody watches: daemons with and without, in turn.

    python -m tools.benchmarks.record [--rounds N] [--rest S]

Each is a process of its own on the simulated rover; each round lets each of them point once at a pixel of
a fresh picture, in turn. Told are the medians over the rounds, processor time of the
whole daemon (most of it draws what the simulated cameras see) and how long a pointing's steps took; then
the processor time of all at rest, at the same time. In brackets: as a part of the plain one's.
"""

from __future__ import annotations

import contextlib
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from mastctl.cli.output import at_least, positive_number
from mastctl.client import Client
from mastctl.packaged import default_config
from tools.command import end, options

PLAIN, NO_RING = "plain", {"ring_s": 0.0}
DAEMONS = {
    PLAIN: {"record": NO_RING},
    "ring": {"record": {"ring_s": 300.0}},
    "live view": {"record": NO_RING, "foxglove": {"port": 0}},
}
CLICK = (400.0, 500.0)


@dataclass(frozen=True)
class Daemon:
    """One of them; ``processor_s`` is what it has used."""

    pid: int
    client: Client

    @property
    def processor_s(self) -> float:
        words = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class RecordedPointing:
    """What one pointing took: processor time, duration, and that of its steps by name."""

    processor_s: float
    whole_s: float
    steps_s: dict[str, float]


def main() -> int:
    """Measure and print a table."""
    parser = options(__doc__, seed=None, tasks=False)
    parser.add_argument("--rounds", type=at_least(1), default=20, metavar="N", help="default 20")
    parser.add_argument("--rest", type=positive_number, default=30.0, metavar="S", help="default 30 s")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as exits:
        daemons = {
            name: exits.enter_context(_daemon(Path(folder) / name, extra)) for name, extra in DAEMONS.items()
        }
        for one in daemons.values():
            _point(one)  # everything is compiled and open
        done = {name: [] for name in daemons}
        for number in range(args.rounds):
            for name in sorted(daemons, reverse=bool(number % 2)):
                done[name].append(_point(daemons[name]))
        before = {name: one.processor_s for name, one in daemons.items()}
        time.sleep(args.rest)
        rest = {name: (one.processor_s - before[name]) / args.rest for name, one in daemons.items()}
        written_mb = sum(one.stat().st_size for one in Path(folder).rglob("*.mcap")) / 1e6
    _tell(done, rest, written_mb)
    return 0


def _tell(done: dict[str, list[RecordedPointing]], rest: dict[str, float], written_mb: float) -> None:
    print(f"{'median of ' + str(len(done[PLAIN])):<32}" + "".join(f"{name:>18}" for name in done))
    _row("processor, s", done, lambda row: row.processor_s)
    _row("begin to end, s", done, lambda row: row.whole_s)
    for step in done[PLAIN][0].steps_s:
        _row(f"step {step}, s", done, lambda row, step=step: row.steps_s.get(step, 0.0))
    print(
        f"{'at rest: processor, % of a core':<32}" + "".join(f"{100 * one:>18.2f}" for one in rest.values())
    )
    print(f"the ring has {written_mb:.1f} MB")


def _row(
    words: str, done: dict[str, list[RecordedPointing]], part: Callable[[RecordedPointing], float]
) -> None:
    found = {name: statistics.median(part(row) for row in rows) for name, rows in done.items()}
    plain = found[PLAIN]
    print(
        f"{words:<32}"
        + "".join(f"{one:>10.3f} ({one / plain if plain else 1.0:.2f}) " for one in found.values())
    )


def _point(daemon: Daemon) -> RecordedPointing:
    """Point at a pixel of a fresh picture."""
    client = daemon.client
    client.wait(client.point(pan_rad=0.0, tilt_rad=-0.1))
    began_s = daemon.processor_s
    shot = client.snapshot("navcam_left")
    record = client.wait(client.point(pixel=("navcam_left", shot.frame_id, *CLICK)))
    if record["state"] != "done":
        raise RuntimeError(f"the pointing failed: {record['error']}")
    steps_s: dict[str, float] = {}
    for step in record["steps"]:
        steps_s[step["name"]] = steps_s.get(step["name"], 0.0) + step["duration_s"]
    return RecordedPointing(daemon.processor_s - began_s, record["ended_s"] - record["created_s"], steps_s)


@contextlib.contextmanager
def _daemon(folder: Path, extra: dict[str, Any]) -> Iterator[Daemon]:
    """A daemon with something more in its configuration."""
    folder.mkdir()
    packaged = default_config().resolve()
    document = yaml.safe_load(packaged.read_text())
    document["listen"] = {"port": 0}
    document["mast_file"] = str(packaged.parent / document["mast_file"])
    document["simulation"]["rover"] = str(packaged.parent / document["simulation"]["rover"])
    document["state"] = {"folder": str(folder / "state")}
    document |= extra
    config = folder / "rover.yaml"
    config.write_text(yaml.safe_dump(document))
    command = [sys.executable, "-m", "mastctl", "run", "--config", str(config)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stdout is not None
            with Client(process.stdout.readline().strip()) as client:
                yield Daemon(process.pid, client)
        finally:
            process.terminate()
            process.wait(20.0)


if __name__ == "__main__":
    end(main)
