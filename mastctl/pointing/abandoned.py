"""Waiting for pictures and numbers that may take seconds, but no longer than until a stop."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

T = TypeVar("T")

LOOKED_S = 0.02  # how late a stop may be noticed


def result_unless(stopped: Callable[[], None], work: Callable[[], T]) -> T:
    """Return what ``work()`` returns; it runs in a thread of its own.

    Only for work that moves nothing: when ``stopped()`` raises, that is raised, and the work goes on to its
    end with nobody to take its result.

    Raises
    ------
    BaseException
        Whatever ``work`` or ``stopped`` raises.
    """
    future: Future[T] = Future()

    def run() -> None:
        try:
            future.set_result(work())
        except BaseException as error:  # it belongs to who waits
            future.set_exception(error)

    threading.Thread(target=run, name="operation's work", daemon=True).start()
    while True:
        try:
            return future.result(LOOKED_S)
        except TimeoutError:
            if future.done():
                return future.result()
        stopped()
