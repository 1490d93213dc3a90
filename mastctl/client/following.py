"""Waiting on a daemon's events: a value as it is, then at each change, also if the stream breaks."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Mapping
from contextlib import closing
from typing import Any, TypeVar, cast

from mastctl.client.connection import Broken, ClientError, DaemonHttp

T = TypeVar("T")

AGAIN_S = (0.1, 0.5, 1.0)  # pauses before a stream that broke is begun again
SILENT_S = 10.0  # the daemon shows every 2 s that it is there
LAST_S = 3.0  # of a wait: then it ends to the moment, and not with the next sign of life
PASSING = ("no_daemon", "timeout", "closing")
LEAST_S = 1.0  # for a request, on a machine that is busy
POLL_S = 0.25  # between requests to a daemon that has no stream left


def followed(
    daemon: DaemonHttp,
    query: Mapping[str, Any],
    request: Callable[[float], T],
    timeout_s: float,
) -> Generator[T, None, None]:
    """Yield a value as it is, then at each change, for some seconds.

    The value is requested before each stream, and each stream begins with what is known, so that no end of
    anything is missed. A stream that breaks is begun again; where the daemon has none left, it is polled.

    ``query`` selects events of one topic and key. ``request`` returns the value by a request of its own that
    may take so many seconds; its ClientError passes: ``no_daemon`` if the daemon is gone,
    ``operation_unknown`` if it is another one.
    """
    until_s = time.monotonic() + timeout_s
    pauses: list[float] = []  # a daemon that does not answer at the beginning is reported at once
    while True:
        try:
            yield request(max(until_s - time.monotonic(), LEAST_S))
            pauses = pauses or list(AGAIN_S)  # it answers
            with closing(_stream(daemon, query, until_s)) as values:
                for value in values:
                    pauses = list(AGAIN_S)
                    yield cast(T, value)
        except ClientError as error:
            if error.code == "too_many":
                pauses = [POLL_S, *AGAIN_S]
            elif not (isinstance(error, Broken) or error.code in PASSING):
                raise
            if not pauses:
                raise
            time.sleep(max(0.0, min(pauses.pop(0), until_s - time.monotonic())))
        if time.monotonic() >= until_s:
            return


def _stream(
    daemon: DaemonHttp, query: Mapping[str, Any], until_s: float
) -> Generator[dict[str, Any], None, None]:
    """Yield a stream's values until it ends, or a time, or some seconds before it."""
    left_s = until_s - time.monotonic()
    if left_s <= 0:
        return
    last = left_s <= LAST_S
    with closing(daemon.heard("/events", query, min(left_s, SILENT_S))) as events:
        for event in events:
            if event is not None:
                yield event["value"]
            left_s = until_s - time.monotonic()
            if left_s <= (0.0 if last else LAST_S):
                return
