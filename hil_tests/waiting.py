"""Waiting in tests for something that must come: the one helper, with one net.

The net is no assertion about speed. It only ends a test whose awaited thing never comes, on a machine that
has eight other busy processes; a test that means "quickly" asserts an order of events instead.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Thread
from typing import TypeVar

from drivers.clock import Clock, SystemClock

NET_S = 60.0
LOOK_EVERY_S = 0.005

T = TypeVar("T")


def until(holds: Callable[[], T], what: str, within_s: float = NET_S, clock: Clock | None = None) -> T:
    """Call ``holds`` until it returns something true, and return that.

    Raises
    ------
    AssertionError
        Naming ``what`` if it did not hold within ``within_s`` seconds of ``clock``, of real time by default.
    """
    clock = clock or SystemClock()
    end_s = clock.now_s() + within_s
    while True:
        if found := holds():
            return found
        if clock.now_s() > end_s:
            raise AssertionError(f"not within {within_s:g} s: {what}")
        clock.sleep(LOOK_EVERY_S)


def joined(*threads: Thread) -> None:
    """Wait until threads have ended; `Thread.join` with a timeout returns also when they have not."""
    until(lambda: not any(one.is_alive() for one in threads), "the end of " + ", ".join(map(str, threads)))


def present(value: T | None) -> T:
    """Return a value that must not be None."""
    assert value is not None
    return value
