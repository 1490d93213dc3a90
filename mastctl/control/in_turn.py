"""One thing after the other from many threads, with nobody waiting for anybody."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Generic, TypeVar

T = TypeVar("T")

MANY = 100


class InTurn(Generic[T]):
    """Takes things one at a time in the order in which they came; safe to use from any thread.

    Whoever brings something takes it, unless another thread is at it already: that one takes it too before
    it goes on. So bringing waits for no lock, however long its holder is kept from running; only when more
    than a hundred things lie there, it waits for its turn to take some of them.

    Parameters
    ----------
    take
        Called with each thing, one call at a time. It must not block and must not raise.
    """

    def __init__(self, take: Callable[[T], None]) -> None:
        self._take = take
        self._brought: deque[T] = deque()
        self._lock = threading.Lock()

    def bring(self, thing: T) -> None:
        """Have something taken: on return it was, or another thread is about to."""
        self._brought.append(thing)
        if len(self._brought) > MANY:
            with self._lock:
                self._take_all()
        self.go_on()

    def leave(self, thing: T) -> None:
        """Leave something for whoever comes next; costs less than anything else could."""
        self._brought.append(thing)

    def go_on(self) -> None:
        """Take what was left, unless another thread is at it."""
        while self._brought and self._lock.acquire(blocking=False):
            try:
                self._take_all()
            finally:
                self._lock.release()

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Be the one who takes inside the block, after all that came before; may wait for another's turn."""
        try:
            with self._lock:
                self._take_all()
                yield
        finally:
            self.go_on()

    def _take_all(self) -> None:
        for _ in range(len(self._brought)):  # those of now: who brings more takes a turn of its own
            self._take(self._brought.popleft())
