"""Waking threads that wait for a frame, at a third of what a condition variable costs.

A thread that is woken through a file descriptor runs at once, because writing to one lets go of Python's
lock; one that is woken through a condition first waits for that lock.
"""

from __future__ import annotations

import contextlib
import math
import os
import select


class Bell:
    """One waiting thread's wake-up call. It may ring once too often: what it was for is to be looked at."""

    def __init__(self) -> None:
        self._fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)

    def wait(self, timeout_s: float) -> None:
        """Return when it rings, at the latest after ``timeout_s``."""
        if self._poll.poll(max(0, math.ceil(1e3 * timeout_s))):
            with contextlib.suppress(BlockingIOError):
                os.eventfd_read(self._fd)

    def ring(self) -> None:
        """Wake who waits, or who waits next."""
        os.eventfd_write(self._fd, 1)

    def close(self) -> None:
        """Give the descriptor back; it may ring no more."""
        os.close(self._fd)


class Bells:
    """The bells of those who wait. All but `Bell.wait` and `ring_all` under one lock of the owner's.

    Bells are used again and closed last, so that nobody rings a descriptor that is somebody else's by now.
    """

    def __init__(self) -> None:
        self._waiting: tuple[Bell, ...] = ()
        self._free: list[Bell] = []
        self._closed = False

    def take(self) -> Bell:
        """Return a bell that is rung from now on, until it is given back."""
        bell = self._free.pop() if self._free else Bell()
        self._waiting += (bell,)
        return bell

    def give_back(self, bell: Bell) -> None:
        """Let others wait with it."""
        self._waiting = tuple(other for other in self._waiting if other is not bell)
        if self._closed:
            bell.close()
        else:
            self._free.append(bell)

    def ring_all(self) -> None:
        """Wake all who wait; from the one thread that rings, not under the lock."""
        for bell in self._waiting:
            bell.ring()

    def close(self) -> None:
        """Close the bells that are free, and the others when they come back; nobody rings any more."""
        self._closed = True
        for bell in self._free:
            bell.close()
        self._free = []
