"""The threads of the stops: full of overdue stops they refuse the next one, and not before."""

from __future__ import annotations

import threading

import pytest

from drivers.clock import ManualClock
from hil_tests.waiting import NET_S, until
from mastctl.service.stopping import OVERDUE_S, StopsHang, StopThreads


def test_a_stop_is_refused_only_when_every_thread_is_overdue() -> None:
    clock, free, entered = ManualClock(), threading.Event(), []

    def hangs() -> str:
        entered.append(clock.now_s())
        free.wait(2 * NET_S)
        return "back"

    threads = StopThreads(2, clock)
    futures = [threads.submit(hangs)]
    until(lambda: len(entered) == 1, "the first one hangs")
    clock.advance(OVERDUE_S)
    futures.append(threads.submit(hangs))
    until(lambda: len(entered) == 2, "the second one hangs")
    clock.advance(OVERDUE_S)
    waits = threads.submit(lambda: "in turn")  # the second one may still come back in time
    clock.advance(0.1)
    with pytest.raises(StopsHang, match=r"2 stops are under way, the oldest for 3\.1 s"):
        threads.submit(hangs)
    free.set()
    assert [future.result(NET_S) for future in (*futures, waits)] == ["back", "back", "in turn"]
    assert threads.submit(lambda: "again").result(NET_S) == "again"
    threads.close()


def test_what_a_stop_raises_is_its_callers_and_the_thread_goes_on() -> None:
    threads = StopThreads(1)

    def fails() -> None:
        raise SystemExit("a driver from outside")

    with pytest.raises(SystemExit):
        threads.submit(fails).result(NET_S)
    assert threads.submit(lambda: 7).result(NET_S) == 7
    threads.close()
