"""Let a daemon live among bad clients, faults and work for a while, and see whether it stays the same.

The daemon is a process of its own on a simulated rover, recorder on. Two clients look at pictures. One
steers: it points at angles, pixels and places, tracks while the rover drives, jogs under a lease, stops and
latches, changes mast files. One tries to steer beside it. Faults come at random by their words; clients
stall and are killed (SIGKILL). Now and then all of them rest, faults are taken back, and the
daemon is weighed. The warm-up ends when each thing that the clients do was done once, and the recorder's ring
has gone round. The daemon gives freed memory back at once, so that what is weighed is what it holds. Wanted,
after the first rest:

- no growth of memory beyond 20 MB, none of threads, none of descriptors;
- every operation ends within its deadline, or 5 s after it, and one that fails says why;
- no answer of 500 and above, and no fault in the status, which no fault that was set explains;
- the head never reads beyond its limits, but for faults that make it read wrongly.
"""

from __future__ import annotations

import statistics
import time
from pathlib import Path

from hil_tests.support.living_daemon import Vitals, simulated, started, vitals
from hil_tests.support.soak_clients import Crowd
from hil_tests.support.soak_ledger import SEES, Ledger

MOST_GROWTH_MB = 20.0
RING_S = 60.0
GIVES_BACK = {
    "MALLOC_ARENA_MAX": "2",
    "MALLOC_MMAP_THRESHOLD_": "131072",
    "MALLOC_TRIM_THRESHOLD_": "131072",
}
"""The C library keeps 150 to 200 MB of freed pictures otherwise, 40 MB more or less from rest to rest."""
WARM_OPERATIONS = 60
"""After fewer, on a busy machine, it still takes memory that stays: 485 MB after 24, 513 to 521 later."""
SETTLE_S = 14.0  # idle threads of the web's pool end after 10 s
WEIGH_S = 4.0


def soak(folder: Path, duration_s: float, seed: int, settle_s: float = SETTLE_S) -> list[str]:
    """Run a daemon among all clients for so long; return what was not as wanted."""
    record = {"ring_s": RING_S, "ring_mb": 100, "kept_mb": 200}
    config = simulated(folder, "memory", SEES, {"record": record})
    ledger = Ledger()
    weighed: list[Vitals] = []
    with started(config, GIVES_BACK) as (daemon, port), Crowd(port, seed, ledger) as crowd:
        for work in (lambda: crowd.warm_up(RING_S, WARM_OPERATIONS), lambda: crowd.work(duration_s)):
            work()
            crowd.rest(settle_s)
            weighed.append(_weigh(daemon.pid))
        ledger.check(daemon.poll() is None, "the daemon has ended by itself")
    if "Traceback" in (said := (folder / "daemon.log").read_text()):
        ledger.check(False, f"the daemon's log has a traceback: {said[said.index('Traceback') :][:1500]}")
    judge(weighed[0], weighed[1], ledger)
    return ledger.wrong


def _weigh(pid: int) -> Vitals:
    """The least memory in some seconds, of those with the most frequent threads and descriptors.

    A thread may just be on its way out, and the recorder between two files: one thread, two descriptors less.
    """
    weighed = [vitals(pid)]
    until_s = time.monotonic() + WEIGH_S
    while time.monotonic() < until_s:
        time.sleep(0.2)
        weighed.append(vitals(pid))
    often = statistics.mode((one.threads, one.descriptors) for one in weighed)
    return min(
        (one for one in weighed if (one.threads, one.descriptors) == often), key=lambda one: one.rss_mb
    )


def judge(first: Vitals, last: Vitals, ledger: Ledger) -> None:
    """Compare the daemon at its last rest with what it was at its first."""
    grown_mb = last.rss_mb - first.rss_mb
    ledger.check(grown_mb <= MOST_GROWTH_MB, f"memory grew by {grown_mb:.1f} MB, {MOST_GROWTH_MB:g} allowed")
    more = last.threads - first.threads
    ledger.check(more <= 0, f"{more} threads more than after the warm-up")
    opened = {
        kind: count - first.open_files.get(kind, 0)
        for kind, count in last.open_files.items()
        if count > first.open_files.get(kind, 0)
    }
    more = last.descriptors - first.descriptors
    ledger.check(more <= 0, f"{more} descriptors more than after the warm-up: {opened}")
