"""Calls of a device under test in a thread of its own, as the service makes them, each with a deadline."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

from drivers.clock import Clock, SystemClock
from drivers.errors import DriverError
from mastctl.conform.checks import NotTried, PromiseBroken, SubjectLost
from mastctl.devices.keep_out import KeptOut
from mastctl.devices.limits import OutsideLimits

T = TypeVar("T")

PATIENCE_S = 12.0


class Worker:
    """One thread that makes a device's calls."""

    def __init__(self) -> None:
        self._calls: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        threading.Thread(target=self._serve, name="device under test", daemon=True).start()

    def call(self, what: str, function: Callable[[], T], patience_s: float = PATIENCE_S) -> T:
        """Make a call in the device's thread. Raises as `ended`."""
        future, run = _task(function)
        self._calls.put(run)
        return ended(what, future, patience_s)

    def close(self) -> None:
        """Let the thread end when its last call is back."""
        self._calls.put(None)

    def _serve(self) -> None:
        while (run := self._calls.get()) is not None:
            run()


def beside(function: Callable[[], T], clock: Clock | None = None) -> Future[T]:
    """Make a call in a thread of its own, one of the clock's, beside those of the device's thread."""
    future, run = _task(function)
    (clock or SystemClock()).thread(run, "beside the device under test").start()
    return future


def ended(what: str, future: Future[T], patience_s: float = PATIENCE_S) -> T:
    """Return what a call returned.

    Raises
    ------
    DriverError
        What the driver raised.
    NotTried
        If the limits or keep-outs refused a move.
    PromiseBroken
        If anything else was raised.
    SubjectLost
        If the call does not come back.
    """
    try:
        return future.result(patience_s)
    except DriverError:
        raise
    except (KeptOut, OutsideLimits) as error:
        raise NotTried(f"{what} was not sent: {error}") from None
    except TimeoutError:
        if future.done():
            raise PromiseBroken(f"{what} raised TimeoutError where a DriverError is expected") from None
        raise SubjectLost(f"{what} has not come back after {patience_s:g} s") from None
    except BaseException as error:
        message = " ".join(str(error).split())[:200]
        raise PromiseBroken(
            f"{what} raised {type(error).__name__} ({message}) where a DriverError is expected"
        ) from error


def _task(function: Callable[[], T]) -> tuple[Future[T], Callable[[], None]]:
    """A future, and the function that fills it."""
    future: Future[T] = Future()

    def run() -> None:
        try:
            future.set_result(function())
        except BaseException as error:  # a foreign driver may raise anything; the caller gets it
            future.set_exception(error)

    return future, run
