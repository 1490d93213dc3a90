"""Who listens to the changes of one daemon, and their end with it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from mastctl.errors import Unable
from mastctl.state.publisher import LoopSubscription, Publisher, Topic

MOST = 100
FULL_S = 1.0


class Streams:
    """Who listens to one daemon; used on its event loop only.

    Parameters
    ----------
    publisher
        What is listened to.
    most
        How many may listen at once, so that they leave connections for everybody else.
    """

    def __init__(self, publisher: Publisher, most: int = MOST) -> None:
        self._publisher = publisher
        self._most = most
        self._open: set[LoopSubscription] = set()
        self._ended = False

    @contextmanager
    def listening(self, topics: tuple[Topic, ...], keys: frozenset[str] | None) -> Iterator[LoopSubscription]:
        """Listen inside the block to topics, all of them if none is named, of some keys or of every one.

        Raises
        ------
        Unable
            ``too_many`` listen already, ``closing``.
        """
        if self._ended:
            raise Unable("closing", "the daemon ends; no more events follow")
        if len(self._open) >= self._most:
            words = f"{self._most} listen to events already, and no more may; ask again later"
            raise Unable("too_many", words, FULL_S)
        with self._publisher.subscribe_here(*topics, keys=keys) as news:
            self._open.add(news)
            try:
                yield news
            finally:
                self._open.discard(news)

    def end(self) -> None:
        """Let every stream tell what it has not told yet, and end."""
        self._ended = True
        for news in tuple(self._open):
            news.close()
