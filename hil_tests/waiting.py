"""Waiting in tests for something that must come: the one helper, with one net.

The net is no assertion about speed. It only ends a test whose awaited thing never comes, on a machine that
has eight other busy processes; a test that means "quickly" asserts an order of events instead.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

NET_S = 60.0
LOOK_EVERY_S = 0.005

T = TypeVar("T")


def until(holds: Callable[[], T], what: str, within_s: float = NET_S) -> T:
    """Call ``holds`` until it returns something true, and return that.

    Raises
    ------
    AssertionError
        Naming ``what`` if it did not hold within ``within_s`` seconds of real time.
    """
    end_s = time.monotonic() + within_s
    while True:
        if found := holds():
            return found
        if time.monotonic() > end_s:
            raise AssertionError(f"not within {within_s:g} s: {what}")
        time.sleep(LOOK_EVERY_S)
