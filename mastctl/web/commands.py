"""What every route is given, and how a request becomes a command: checks first, or the act first for a stop.

The routes are made once a process, whatever many daemons it holds: a request brings its daemon's parts.
"""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from inspect import Parameter
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

from fastapi import Depends, FastAPI, Header, Request
from fastapi.requests import HTTPConnection
from fastapi.responses import FileResponse
from pydantic import BaseModel, ConfigDict

from mastctl.as_json import readable
from mastctl.control.entry import Answer, Command, CommandRequest
from mastctl.control.lease import Caller
from mastctl.errors import Unable
from mastctl.http import PREFIX
from mastctl.http.guard import EntryRules
from mastctl.http.waiting import Streams, Waiting
from mastctl.motion.requests import DeadlineS
from mastctl.service.service import Service
from mastctl.service.stopping import StopsHang
from mastctl.web.pictures import CameraFeeds

T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Mapping[str, Any]])

STOP_ANSWER_S = 3.0  # the devices give a stop 1 s; beyond this the answer is that nothing is known
NOTHING: Mapping[str, Any] = {}
REFERENCE = "#/components/schemas/{model}"


@dataclass(frozen=True)
class Parts:
    """What serves one daemon's requests, with the rules for its clients and the pictures for its viewers."""

    service: Service
    waiting: Waiting
    streams: Streams
    entrance: EntryRules
    feeds: CameraFeeds
    requested: CommandRequest = field(default_factory=lambda: CommandRequest(Caller()))
    """What the headers of a request for a command say, and when it came."""


async def _parts(line: HTTPConnection) -> Parts:
    return cast(Parts, line.scope["state"]["parts"])


Here = Annotated[Parts, Depends(_parts)]


class StrictQuery(BaseModel):
    """A query without unknown names; its numbers come as text."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


def stream_of(kind: str) -> dict[int | str, dict[str, Any]]:
    """Describe a route of server-sent events: one line each, ``data:`` and JSON of a kind."""
    event = {"$ref": REFERENCE.format(model=kind)}
    stream = {"schema": {"type": "string"}, "x-endless": True, "x-event": event}
    return {200: {"content": {"text/event-stream": stream}}}


def file_of(*kinds: str, **others: Any) -> dict[int | str, dict[str, Any]]:
    """Describe a route whose answer is a file of one of these media types."""
    form = {"type": "string", "format": "binary"}
    return {200: {"content": {kind: {"schema": form} for kind in kinds}, **others}}


def whole_file(path: Path) -> FileResponse:
    """Answer with a file, whole, since the guard passes no request for a part of one."""
    return FileResponse(path, media_type="application/octet-stream", filename=readable(path.name))


async def _commanded(
    request: Request,
    here: Here,
    mastctl_client: Annotated[str | None, Header(description="The client's name")] = None,
    mastctl_lease: Annotated[str | None, Header(description="The id of the lease that it holds")] = None,
    idempotency_key: Annotated[
        str | None, Header(description="The same for each try of one command, which is carried out once")
    ] = None,
    deadline_s: Annotated[
        DeadlineS | None, Header(description="How long the command is given, seconds")
    ] = None,
) -> Parts:
    service = here.service
    now_s, last_stop = service.clock.now_s(), service.leases.last_stop
    requested = CommandRequest(
        caller_of(request), now_s, NOTHING, mastctl_lease, idempotency_key, deadline_s, last_stop
    )
    return replace(here, requested=requested)


def command(
    app: FastAPI,
    route: str,
    kind: Command,
    *,
    usual_s: Callable[..., float] | None = None,
    beside: bool = False,
    status_code: int = 200,
) -> Callable[[F], F]:
    """Add the route of a command, whose function carries it out, in a worker thread, once the entry lets it.

    ``route`` is method and path below the prefix, ``POST /point``. The function takes ``here``, with what is
    ``requested``, and the path, the query and the body; its docstring is the route's summary. ``usual_s``, of
    the function's parameters, is an operation's time without a deadline; a ``deadline_s`` in the body counts
    as the header does, the shorter of both. ``beside``: it stops something, so it runs in the stops' own
    threads, and each try is carried out.
    """
    method, _, path = route.partition(" ")

    def add(act: F) -> F:
        wanted, summary = inspect.signature(act, eval_str=True), (inspect.getdoc(act) or "").rstrip(".")

        async def endpoint(request: Request, **given: Any) -> Mapping[str, Any]:
            request.scope["state"]["recorded"] = True  # whatever comes of it
            here: Parts = given["here"]
            sent = _request_of(given)
            allowed_s = None if usual_s is None else usual_s(**given)
            deadlines_s = [here.requested.deadline_s, sent.get("deadline_s")]
            deadline_s = min((one for one in deadlines_s if one is not None), default=None)
            requested = replace(here.requested, request=sent, deadline_s=deadline_s)
            if beside:
                requested = replace(requested, key=None, deadline_s=None)

            def work() -> Mapping[str, Any]:
                return here.service.entry.run(kind, requested, partial(act, **given), allowed_s)

            return await (stopped(here.service, work) if beside else here.waiting.run(work))

        own = {"request": Request, "here": Annotated[Parts, Depends(_commanded)]}
        parameters = [Parameter(name, Parameter.KEYWORD_ONLY, annotation=one) for name, one in own.items()]
        others = (one for name, one in wanted.parameters.items() if name not in own)
        parameters += [one.replace(kind=Parameter.KEYWORD_ONLY) for one in others]
        endpoint.__signature__ = wanted.replace(parameters=parameters)  # type: ignore[attr-defined]
        endpoint.__annotations__ = {"return": wanted.return_annotation}
        endpoint.__name__ = act.__name__
        app.add_api_route(PREFIX + path, endpoint, methods=[method], summary=summary, status_code=status_code)
        return act

    return add


async def stop_first(
    here: Parts,
    kind: Command,
    request: Request,
    act: Callable[[], Answer],
    sent: Mapping[str, Any] = NOTHING,
) -> Answer:
    """Return the answer of a stop, which acts before any check."""
    requested = CommandRequest(caller_of(request), request=sent, lease=request.headers.get("mastctl-lease"))
    entry = here.service.entry
    try:
        return await stopped(here.service, lambda: entry.first(kind, requested, act))
    except StopsHang as error:
        entry.record(kind, requested, None, error)
        raise


async def stopped(service: Service, stop: Callable[[], T]) -> T:
    """Run a stop in the threads that are there for it. Raises Unable ``stop_pending``, DriverError."""
    try:
        return await asyncio.wait_for(asyncio.wrap_future(service.stop_threads.submit(stop)), STOP_ANSWER_S)
    except TimeoutError:
        message = f"the stop did not come back within {STOP_ANSWER_S:g} s; the head may still move"
        raise Unable("stop_pending", message) from None


def caller_of(line: HTTPConnection) -> Caller:
    """Return the caller that the guard found."""
    return cast(Caller, line.scope["state"]["caller"])


def _request_of(given: Mapping[str, Any]) -> dict[str, Any]:
    """What a request says in its path, its query and its body."""
    sent: dict[str, Any] = {}
    for name, value in given.items():
        if isinstance(value, BaseModel):
            sent |= value.model_dump(exclude_none=True)
        elif name != "here" and value is not None:
            sent[name] = value
    return sent
