"""Waiting for pictures and numbers that may take seconds, but no longer than until a stop."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

from drivers.clock import Clock

T = TypeVar("T")

LOOKED_S = 0.02  # how late a stop may be noticed


def result_unless(stopped: Callable[[], None], work: Callable[[], T], clock: Clock) -> T:
    """Return what ``work()`` returns; it runs in a thread of its own.

    Only for work that moves nothing: when ``stopped()`` raises, that is raised, and the work goes on to its
    end with nobody to take its result. ``clock`` is one that goes on while somebody waits.

    Raises
    ------
    BaseException
        Whatever ``work`` or ``stopped`` raises.
    """
    future: Future[T] = Future()
    ended = clock.signal()

    def run() -> None:
        try:
            future.set_result(work())
        except BaseException as error:  # it belongs to who waits
            future.set_exception(error)
        with ended:
            ended.notify_all()

    clock.thread(run, "operation's work").start()
    while True:
        with ended:
            if not future.done():
                ended.wait(LOOKED_S)
        if future.done():
            return future.result()
        stopped()
