"""What a daemon costs: its import, its start until it answers, its end; median of several, in turn.

    python -m tools.benchmarks.start [--repeats N]

The daemon has a simulated head in memory and no camera. Processor time beside the time that passed; the first
daemon of a process makes the routes for all that follow.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.request import urlopen

from mastctl.cli.output import at_least
from mastctl.config import load_config
from mastctl.daemon import RunningDaemon
from tools.command import end, options
from tools.living_daemon import simulated

Spent = dict[str, list[tuple[float, float]]]


def main() -> None:
    """Measure and print a table."""
    parser = options(__doc__, seed=None, tasks=False)
    parser.add_argument("--repeats", type=at_least(1), default=10, metavar="N", help="default 10")
    args = parser.parse_args()
    spent: Spent = {}
    for _ in range(args.repeats):
        with _spending(spent, "import mastctl.daemon"):
            subprocess.run([sys.executable, "-c", "import mastctl.daemon"], check=True)
    with tempfile.TemporaryDirectory() as folder:
        path = simulated(Path(folder), "memory", ())
        _daemon(path, spent, "first of the process: ")
        for _ in range(args.repeats):
            _daemon(path, spent, "")
    print(f"{'seconds, median':40s} processor   passed")
    for what, times in spent.items():
        processor_s, passed_s = (statistics.median(one) for one in zip(*times, strict=True))
        print(f"{what:40s} {processor_s:9.3f} {passed_s:8.3f}")


def _daemon(path: Path, spent: Spent, which: str) -> None:
    """Start one, have it answer, end it."""
    config = load_config(path)
    with _spending(spent, f"{which}start until it answers"):
        daemon = RunningDaemon(config)
        with urlopen(f"{daemon.url}/api/v1/health/live", timeout=60.0):
            pass
    with _spending(spent, f"{which}close"):
        daemon.close()


@contextmanager
def _spending(spent: Spent, what: str) -> Iterator[None]:
    """Note what the block takes: processor time with that of processes that ended in it, and time passed."""
    before, before_s = os.times(), time.monotonic()
    yield
    processor_s = sum(os.times()[:4]) - sum(before[:4])
    spent.setdefault(what, []).append((processor_s, time.monotonic() - before_s))


if __name__ == "__main__":
    end(main)
