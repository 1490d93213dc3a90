"""Simulated GigE Vision cameras run in one worker at a time.

Two files that ran at the same time, each at an address of its own, got pictures stamped by one another's
camera.
"""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from hil_tests.waiting import until

OTHERS_S = 1800.0  # another worker's whole file, on a busy machine


def _locked(lock: socket.socket) -> bool:
    """Whether this process has the name, which goes with the process."""
    try:
        lock.bind("\0mastctl tests: one file with GigE Vision cameras")
    except OSError:
        return False
    return True


@pytest.fixture(scope="module", autouse=True)
def one_file_at_a_time() -> Iterator[None]:
    with socket.socket(socket.AF_UNIX) as lock:
        until(lambda: _locked(lock), "the other worker's cameras to end", OTHERS_S)
        yield
