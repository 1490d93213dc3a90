"""What is no stop is taken up in turn, one piece in each turn of the event loop.

However many ask at once, what a stop still waits for is the work of a few of them, not of all.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable


class Turns:
    """What waits to be taken up on one event loop; used on that loop only."""

    def __init__(self) -> None:
        self._waiting: deque[Callable[[], None]] = deque()

    def call(self, function: Callable[[], None]) -> None:
        """Have a function called when all that came before has had a turn of the event loop."""
        self._waiting.append(function)
        if len(self._waiting) == 1:
            asyncio.get_running_loop().call_soon(self._next)

    async def turn(self) -> None:
        """Return when all that came before has had its turn."""
        mine: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.call(lambda: None if mine.done() else mine.set_result(None))
        await mine

    def _next(self) -> None:
        try:
            self._waiting[0]()
        finally:
            self._waiting.popleft()  # now, so that what it has called comes a turn later
            if self._waiting:
                asyncio.get_running_loop().call_soon(self._next)
