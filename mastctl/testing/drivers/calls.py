"""Calls of a device under test in threads of their own, each with a deadline."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

from drivers.clock import Clock, SystemClock
from drivers.errors import DriverError
from mastctl.conform.checks import NotTried, PromiseBroken, SubjectLost
from mastctl.devices.judge import OutsideLimits
from mastctl.devices.keep_out import KeptOut

T = TypeVar("T")

PATIENCE_S = 12.0


def call(what: str, function: Callable[[], T], patience_s: float = PATIENCE_S) -> T:
    """Make a call in a thread of its own and wait for it. Raises as `ended`."""
    return ended(what, beside(function), patience_s)


def beside(function: Callable[[], T], clock: Clock | None = None) -> Future[T]:
    """Begin a call in a thread of its own, one of the clock's, and return at once."""
    future: Future[T] = Future()

    def run() -> None:
        try:
            future.set_result(function())
        except BaseException as error:  # a foreign driver may raise anything; the caller gets it
            future.set_exception(error)

    (clock or SystemClock()).thread(run, "device under test").start()
    return future


def ended(what: str, future: Future[T], patience_s: float = PATIENCE_S) -> T:
    """Return what a call returned; raise the driver's own DriverError.

    Raises NotTried if limits or keep-outs refused a move, PromiseBroken for any other error, SubjectLost if
    the call does not come back.
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
