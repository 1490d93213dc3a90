# Made by tools/async_client.py; what is to be changed is changed in its source.
"""Asyncio: Waiting on a daemon's events: a value as it is, then at each change, also if the stream breaks."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from typing import Any, TypeVar, cast

from mastctl.client.async_connection import AsyncDaemonHttp
from mastctl.client.connection import Broken, ClientError

T = TypeVar("T")
AGAIN_S = (0.1, 0.5, 1.0)
SILENT_S = 10.0
LAST_S = 3.0
PASSING = ("no_daemon", "timeout", "closing")
ASK_S = 0.25


async def async_followed(
    daemon: AsyncDaemonHttp, query: Mapping[str, Any], ask: Callable[[], Awaitable[T]], timeout_s: float
) -> AsyncIterator[T]:
    """Yield a value as it is, then at each change, for some seconds.

    The value is asked for before each stream, and each stream begins with what is known, so that no end of
    anything is missed. A stream that breaks is begun again; where the daemon has none left, it is asked.

    Parameters
    ----------
    query
        Which events, of one topic and key.
    ask
        Returns the value by a request of its own.

    Raises
    ------
    ClientError
        What ``ask`` raises: ``no_daemon`` if the daemon is gone, ``operation_unknown`` if it is another one.
    """
    until_s = time.monotonic() + timeout_s
    pauses: list[float] = []
    while True:
        try:
            yield (await ask())
            pauses = pauses or list(AGAIN_S)
            async for value in _stream(daemon, query, until_s):
                pauses = list(AGAIN_S)
                yield cast(T, value)
        except ClientError as error:
            if error.code == "too_many":
                pauses = [ASK_S, *AGAIN_S]
            elif not (isinstance(error, Broken) or error.code in PASSING):
                raise
            if not pauses:
                raise
            await asyncio.sleep(max(0.0, min(pauses.pop(0), until_s - time.monotonic())))
        if time.monotonic() >= until_s:
            return


async def _stream(
    daemon: AsyncDaemonHttp, query: Mapping[str, Any], until_s: float
) -> AsyncIterator[dict[str, Any]]:
    """Yield a stream's values until it ends, or a time, or some seconds before it."""
    left_s = until_s - time.monotonic()
    if left_s <= 0:
        return
    last = left_s <= LAST_S
    async for event in daemon.heard("/events", query, min(left_s, SILENT_S)):
        if event is not None:
            yield event["value"]
        left_s = until_s - time.monotonic()
        if left_s <= (0.0 if last else LAST_S):
            return
