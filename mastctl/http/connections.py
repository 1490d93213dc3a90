"""Connections as the daemon takes them: many, silent, slow or stalled ones never keep the next one out.

uvicorn bounds neither how many connections there are nor how long one may be silent before its first request.
Here the descriptors of the process are shared out: some stay free, the rest is the most connections. Beyond
it the oldest connection that waits for a request is closed for each new one; where every one is at work,
the new one is served for stop and status only. Some are kept by nobody for long: a request
must have come whole within some seconds, and a client that takes no bytes for some seconds is left. What is
no stop is read in turn, so that a stop passes whatever else has come.
"""

from __future__ import annotations

import asyncio
import logging
import re
import resource
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Protocol, cast

import h11
from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from mastctl.control.caller import Caller
from mastctl.http import PREFIX
from mastctl.http.guard import STOP_LINE, STOPS, TRACK_STOP, stop_named
from mastctl.http.refusals import error_response
from mastctl.http.waiting import Turns

log = logging.getLogger(__name__)
log.setLevel(logging.ERROR)

REQUEST_S = 10.0  # for a request to come whole, from the connection's beginning or the answer before
STALLED_S = 10.0  # for a client that does not read its answer
SWEEP_S = 0.5
MOST = 200
LEAST = 8
FREE_DESCRIPTORS = 24  # for devices that come back, mast files, and what is accepted before it is counted
MOST_UNREAD_BYTES = 1 << 16  # of one connection, until its turn
ACCEPTED_AT_ONCE = 4  # connections taken in one turn of the event loop
WAITING_IN_KERNEL = 128  # connections that the kernel keeps for us meanwhile
ALWAYS = frozenset({*STOPS, TRACK_STOP, f"{PREFIX}/status"})
"""What is served to whoever comes."""
EVENTS = f"{PREFIX}/events"
IMAGES = f"{PREFIX}/images"
SOCKETS = frozenset({EVENTS, IMAGES})
"""Where a connection may become a WebSocket."""
_HEADERS_END = re.compile(rb"\n\r?\n")


class Counted(Protocol):
    """What stands among a server's connections."""

    @property
    def waits(self) -> bool:
        """Whether no whole request is here."""
        ...

    @property
    def waits_since_s(self) -> float:
        """Since when, by the event loop's time."""
        ...

    def overdue(self, now_s: float) -> bool:
        """Whether it takes too long."""
        ...

    def leave(self) -> None:
        """Close it at once."""
        ...

    def end_reading(self, stands: Callable[[str], bool]) -> None:
        """Close it if it reads by a credential that lets in no more."""
        ...


def room_for(newcomer: Counted, connections: set[Any], most: int) -> bool:
    """Close the connection that waits longest for a request if there are too many; False if none waits."""
    if len(connections) <= most:
        return True
    others = [one for one in counted(connections) if one is not newcomer and one.waits]
    if not others:
        return False
    oldest = min(others, key=lambda one: one.waits_since_s)
    connections.discard(oldest)  # counted no longer, although its closing takes a turn of the loop
    oldest.leave()
    return True


def counted(connections: Iterable[Any]) -> list[Counted]:
    """Return those that know how long they wait."""
    return [one for one in connections if hasattr(one, "waits_since_s")]


def most_connections() -> int:
    """Return how many connections this process can keep, by its limit of descriptors and those in use."""
    limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    in_use = sum(1 for _ in Path("/proc/self/fd").iterdir())
    return max(LEAST, min(MOST, limit - in_use - FREE_DESCRIPTORS))


class Connection(H11Protocol):
    """One connection, which knows how long it has waited for a request, and for its client to read.

    Attributes
    ----------
    most
        How many there may be.
    turns
        In which what is no stop is read.
    """

    most = MOST
    turns: Turns

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.logger = log  # what strangers send is no warning
        self.waits_since_s = 0.0
        self._stalled_since_s: float | None = None
        self._unread = b""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.waits_since_s = self.loop.time()
        if not room_for(self, self.connections, self.most):
            self.app = cast(Any, _Crowded(cast(ASGIApp, self.app)))

    def data_received(self, data: bytes) -> None:
        if self._unread:
            self._unread += data
            if len(self._unread) > MOST_UNREAD_BYTES:
                self.transport.pause_reading()
        elif STOP_LINE.match(data):
            super().data_received(data)
        else:
            self._unread = data
            self.turns.call(self._read)

    def _read(self) -> None:
        """Read what came, now that it is its turn."""
        data, self._unread = self._unread, b""
        if not self.transport.is_closing():
            super().data_received(data)
            if len(data) > MOST_UNREAD_BYTES and not self.flow.read_paused:
                self.transport.resume_reading()

    def handle_events(self) -> None:
        doubt = _doubt(self.conn.trailing_data[0]) if self.conn.their_state is h11.IDLE else ""
        if doubt:
            self._refuse("ambiguous", doubt)
        else:
            super().handle_events()

    def send_400_response(self, msg: str) -> None:
        self._refuse("not_http", "this is no HTTP request, or its headers are too large")

    def _refuse(self, code: str, words: str) -> None:
        """Refuse what the API will never see in the one form of refusals, and close."""
        if self.conn.our_state not in (h11.IDLE, h11.SEND_RESPONSE):
            self.leave()  # an answer is half sent
            return
        refused = error_response(400, code, words)
        headers = [*refused.raw_headers, (b"connection", b"close")]
        for event in (
            h11.Response(status_code=400, headers=headers, reason=b"Bad Request"),
            h11.Data(data=bytes(refused.body)),
            h11.EndOfMessage(),
        ):
            self.transport.write(self.conn.send(event) or b"")
        if self.cycle is not None:
            self.cycle.disconnected = True  # nobody hears what it still says
            self.cycle.message_event.set()
        self.transport.close()

    def _should_upgrade(self) -> bool:
        """Whether this becomes a WebSocket: at an address that has one, and if there is room for it."""
        crowded = isinstance(self.app, _Crowded)
        listens = self.scope["path"] in SOCKETS and self.scope["method"] == "GET"
        return listens and not crowded and super()._should_upgrade()

    def on_response_complete(self) -> None:
        self.waits_since_s = self.loop.time()
        super().on_response_complete()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._stalled_since_s = self.loop.time()

    def resume_writing(self) -> None:
        super().resume_writing()
        self._stalled_since_s = None

    @property
    def waits(self) -> bool:
        """Whether no whole request is here."""
        return self.cycle is None or self.cycle.response_complete or self.cycle.more_body

    def overdue(self, now_s: float) -> bool:
        """Whether its request, or its client's reading, has taken too long."""
        stalled_s = self._stalled_since_s
        if stalled_s is not None and now_s - stalled_s > STALLED_S:
            return True
        return self.waits and now_s - self.waits_since_s > REQUEST_S

    def leave(self) -> None:
        """Close it at once, whatever its client still expects."""
        self.transport.abort()

    def end_reading(self, stands: Callable[[str], bool]) -> None:
        """Close it if a long answer is read by a credential that lets in no more; what acts goes on."""
        if not self.waits and self.scope["method"] == "GET" and not let_in(self.scope, stands):
            self.leave()


def let_in(scope: Mapping[str, Any], stands: Callable[[str], bool]) -> bool:
    """Return whether what a request's caller showed, if anything, still lets in."""
    caller = scope["state"].get("caller")
    return not isinstance(caller, Caller) or not caller.credential or stands(caller.credential)


def _doubt(data: bytes) -> str:
    """What h11 would join in a request's headers and another program may read otherwise; '' if nothing."""
    end = _HEADERS_END.search(data)
    if end is None or STOP_LINE.match(data):  # a stop is one, however it is written
        return ""
    lines = data[: end.start()].lower().split(b"\n")[1:]
    if any(line.startswith((b" ", b"\t")) for line in lines):
        return "a header goes on in a second line"
    lengths = [line for line in lines if line.startswith(b"content-length:")]
    return "the header content-length is there twice" if len(lengths) > 1 or b"," in b"".join(lengths) else ""


async def sweep(connections: Iterable[Any], stands: Callable[[str], bool] = lambda credential: True) -> None:
    """Leave overdue connections, and readers whose token has ended, until cancelled."""
    while True:
        await asyncio.sleep(SWEEP_S)
        now_s = asyncio.get_running_loop().time()
        for one in counted(list(connections)):
            if one.overdue(now_s):
                one.leave()
            else:
                one.end_reading(stands)


class _Crowded:
    """The application for who comes when every other connection is at work."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if stop_named(scope)["path"] in ALWAYS:
            await self._app(scope, receive, send)
            return
        response = error_response(
            503,
            "too_many",
            "every connection of the daemon is at work; ask again later",
            headers={"Retry-After": "1", "Connection": "close"},
        )
        await response(scope, receive, send)
