"""The event stream: each change, pushed as it comes, as server-sent events or through a WebSocket.

A listener begins with what is known and then gets the newest of each topic and key. One that reads slowly
loses values in between and is sent their number; nothing waits for it. A WebSocket of events ends with the
first message that its client sends.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from typing import Annotated, Self, cast
from weakref import WeakKeyDictionary

from fastapi import FastAPI, Query, WebSocket
from fastapi.responses import StreamingResponse
from pydantic import Field, model_validator
from starlette.requests import HTTPConnection
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocketDisconnect

from mastctl.as_json import writable
from mastctl.control.publisher import TOPICS, LoopSubscription, Published, Topic
from mastctl.http import PREFIX
from mastctl.motion.requests import Name
from mastctl.service.service import Service
from mastctl.web.commands import Here, Parts, StrictQuery, caller_of, stream_of

EVENTS = f"{PREFIX}/events"
MOST_KEYS = 16
ALIVE_S = 2.0  # between signs of life where nothing changes
GOING_AWAY, UNSUPPORTED, NOT_ALLOWED = 1001, 1003, 1008  # RFC 6455, 7.4.1
AT_ONCE = 16  # events, in one turn of the event loop
AGES_HOLD_S = 0.02  # for how long a text that has an age is sent to other listeners too
AGELESS: frozenset[Topic] = frozenset({"operation", "mast", "command", "bench"})
"""Topics whose values have no age."""


class EventsQuery(StrictQuery):
    """``GET /events``: ``topics`` with commas between, all of them when left out; ``key``: of these only."""

    topics: Annotated[str, Field(max_length=200)] | None = None
    key: Annotated[list[Name], Field(max_length=MOST_KEYS)] | None = None

    @model_validator(mode="after")
    def _known(self) -> Self:
        unknown = [name for name in self.names if name not in TOPICS]
        if unknown:
            raise ValueError(f"topics: {unknown[0]!r} where some of {', '.join(sorted(TOPICS))} are expected")
        return self

    @property
    def names(self) -> tuple[Topic, ...]:
        """The topics, none for all."""
        return tuple(cast(Topic, name.strip()) for name in (self.topics or "").split(",") if name.strip())

    @property
    def keys(self) -> frozenset[str] | None:
        """The keys, None for all."""
        return None if self.key is None else frozenset(self.key)


def add_events(app: FastAPI) -> None:
    """The event stream."""

    @app.get(
        EVENTS,
        summary="Each change as server-sent events, or through a WebSocket at the same address",
        response_class=StreamingResponse,
        responses=stream_of("Event"),
    )
    async def events(query: Annotated[EventsQuery, Query()], here: Here) -> StreamingResponse:
        return _Lines(here, query)

    @app.websocket(EVENTS)
    async def socket(line: WebSocket, query: Annotated[EventsQuery, Query()], here: Here) -> None:
        with here.streams.listening(query.names, query.keys, caller_of(line).credential) as news:
            await _send(line, news, here)


_texts: WeakKeyDictionary[Published, tuple[str, float]] = WeakKeyDictionary()
"""The values of events as JSON, made once for all listeners, and when."""


def _event(service: Service, one: Published, lost: int) -> str:
    now_s, known = service.clock.now_s(), _texts.get(one)
    if known is None or not (one.topic in AGELESS or 0.0 <= now_s - known[1] <= AGES_HOLD_S):
        text = json.dumps(writable(service.event_value(one.topic, one.value)), allow_nan=False)
        known = _texts[one] = text, now_s
    head = json.dumps({"topic": one.topic, "key": one.key, "sequence": one.sequence, "lost": lost})
    return f'{head[:-1]}, "value": {known[0]}}}'


class _Lines(StreamingResponse):
    """Events as server-sent ones, until the daemon or the client ends."""

    def __init__(self, here: Parts, query: EventsQuery) -> None:
        super().__init__(self._lines(), media_type="text/event-stream")
        self._here, self._query = here, query

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        query, credential = self._query, caller_of(HTTPConnection(scope)).credential
        with self._here.streams.listening(query.names, query.keys, credential) as self._news:
            await super().__call__(scope, receive, send)

    async def _lines(self) -> AsyncIterator[str]:
        async for some in _texts_of(self._here, self._news):
            yield "".join(f"id: {number}\ndata: {text}\n\n" for number, text in some) or ": alive\n\n"


async def _texts_of(here: Parts, news: LoopSubscription) -> AsyncIterator[list[tuple[int, str]]]:
    """Numbers and texts of events until they end, by so few that a stop waits for a moment only; none of them
    where nothing changes for a while.
    """
    while (found := await news.wait(ALIVE_S)) or not news.closed:
        for begin in range(0, max(len(found), 1), AT_ONCE):
            await here.waiting.turn()
            some = found[begin : begin + AT_ONCE]
            yield [(one.sequence, _event(here.service, one, news.lost)) for one in some]


async def _send(line: WebSocket, news: LoopSubscription, here: Parts) -> None:
    """Send events through a WebSocket until the daemon or the client ends."""
    await line.accept()
    gone = asyncio.ensure_future(line.receive())  # a client's only message is its end
    gone.add_done_callback(lambda _: news.close())
    try:
        async for some in _texts_of(here, news):
            for _, text in some:
                await line.send_text(text)
        if not gone.done():
            await close_ended(line, here)
        elif gone.result()["type"] == "websocket.receive":
            await line.close(UNSUPPORTED, "this WebSocket takes no messages")
    except WebSocketDisconnect:
        pass
    finally:
        gone.cancel()


async def close_ended(line: WebSocket, here: Parts) -> None:
    """Close a WebSocket whose stream has ended: with the daemon, or with its token."""
    if here.streams.ended:
        await line.close(GOING_AWAY)
    else:
        await line.close(NOT_ALLOWED, "the token that opened this has ended")
