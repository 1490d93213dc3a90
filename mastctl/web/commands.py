"""How a request becomes a command: one way for all of them, and the other way round for a stop."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import replace
from functools import partial
from inspect import Parameter
from typing import Annotated, Any, TypeVar

from fastapi import Depends, FastAPI, Header, Request
from pydantic import BaseModel

from mastctl.control.entry import Answer, Command, CommandRequest
from mastctl.control.lease import Caller, client_name
from mastctl.errors import Unable
from mastctl.http import PREFIX
from mastctl.motion.requests import DeadlineS
from mastctl.service.service import Service
from mastctl.service.stopping import StopsHang
from mastctl.web.parts import Here, Parts

T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Mapping[str, Any]])

STOP_ANSWER_S = 3.0  # the devices give a stop 1 s; beyond this the answer is that nothing is known
NOTHING: Mapping[str, Any] = {}


async def _asked(
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
) -> CommandRequest:
    service = here.service
    now_s, last_stop = service.clock.now_s(), service.leases.last_stop
    return CommandRequest(
        caller_of(request), now_s, NOTHING, mastctl_lease, idempotency_key, deadline_s, last_stop
    )


Asks = Annotated[CommandRequest, Depends(_asked)]
"""What the headers of a request for a command say, and when it came."""


def command(
    app: FastAPI,
    route: str,
    kind: Command,
    summary: str,
    *,
    usual_s: Callable[..., float] | None = None,
    recorded: Callable[..., Mapping[str, Any]] | None = None,
    beside: bool = False,
    status_code: int = 200,
) -> Callable[[F], F]:
    """Add the route of a command, whose function carries it out, in a worker thread, once the entry lets it.

    The function takes what the path, the query and the body hold, and ``here`` and ``asked`` (`Asks`) if it
    needs them.

    Parameters
    ----------
    route
        Method and path below the prefix, ``POST /point``.
    usual_s
        What an operation of it is given if nothing else was asked for, from ``here`` and what the function
        takes.
    recorded
        What it is recorded and known again by, from what the function takes; by default the path, the query
        and the body.
    beside
        Whether it stops something: it runs in the stops' own threads then, and each try is carried out.
    """
    method, _, path = route.partition(" ")

    def add(act: F) -> F:
        wanted = inspect.signature(act, eval_str=True)

        async def endpoint(
            request: Request, here: Parts, asked: CommandRequest, **given: Any
        ) -> Mapping[str, Any]:
            own = {name: one for name, one in (("here", here), ("asked", asked)) if name in wanted.parameters}
            sent = recorded(**given, **own) if recorded is not None else _request_of(given)
            allowed_s = None if usual_s is None else usual_s(here, **given)
            work = partial(act, **given, **own)
            return await carried_out(here, request, kind, asked, sent, work, allowed_s, beside)

        kinds = {"request": Request, "here": Here, "asked": Asks}
        parameters = [Parameter(name, Parameter.KEYWORD_ONLY, annotation=one) for name, one in kinds.items()]
        parameters += [
            one.replace(kind=Parameter.KEYWORD_ONLY)
            for name, one in wanted.parameters.items()
            if name not in kinds
        ]
        endpoint.__signature__ = wanted.replace(parameters=parameters)  # type: ignore[attr-defined]
        endpoint.__annotations__ = {"return": wanted.return_annotation}
        endpoint.__name__ = act.__name__
        app.add_api_route(PREFIX + path, endpoint, methods=[method], summary=summary, status_code=status_code)
        return act

    return add


async def carried_out(
    here: Parts,
    request: Request,
    kind: Command,
    asked: CommandRequest,
    sent: Mapping[str, Any],
    act: Callable[[], Answer],
    usual_s: float | None = None,
    beside: bool = False,
) -> Answer:
    """Return the answer of a command, whose refusals are those of `mastctl.control.entry.CommandEntry.run`.

    A ``deadline_s`` in what is ``sent`` counts as the header does, the shorter of both. ``beside``: of the
    request nothing is kept but who asks, when, and under which lease.
    """
    request.scope["state"]["recorded"] = True  # whatever comes of it
    deadline_s = _shorter(asked.deadline_s, sent.get("deadline_s"))
    if beside:
        asked = replace(asked, key=None)
        return await stopped(here.service, lambda: here.service.entry.run(kind, asked, act))
    asked = replace(asked, request=sent, deadline_s=deadline_s)
    return await here.waiting.run(lambda: here.service.entry.run(kind, asked, act, usual_s))


async def stop_first(
    here: Parts,
    kind: Command,
    request: Request,
    act: Callable[[], Answer],
    sent: Mapping[str, Any] = NOTHING,
    late: Callable[[], Awaitable[Mapping[str, Any]]] | None = None,
) -> Answer:
    """Return the answer of a stop: nothing is asked and no header is judged before it acts.

    ``late`` returns what was ``sent`` after that; the stop is recorded with it then.
    """
    asked = CommandRequest(caller_of(request), request=sent, lease=request.headers.get("mastctl-lease"))
    entry, answer, failure = here.service.entry, None, None
    try:
        answer = await stopped(here.service, lambda: entry.first(kind, asked, act, late is None))
        return answer
    except BaseException as error:
        failure = error
        raise
    finally:
        try:
            if late is not None:
                asked = replace(asked, request=await late())
        finally:
            if late is not None or isinstance(failure, StopsHang):
                entry.record(kind, asked, answer, failure, begins=False)


async def stopped(service: Service, stop: Callable[[], T]) -> T:
    """Run a stop in the threads that are there for it. Raises Unable ``stop_pending``, DriverError."""
    try:
        return await asyncio.wait_for(asyncio.wrap_future(service.stop_threads.submit(stop)), STOP_ANSWER_S)
    except TimeoutError:
        words = f"the stop did not come back within {STOP_ANSWER_S:g} s; the head may still move"
        raise Unable("stop_pending", words) from None


def caller_of(request: Request) -> Caller:
    """Return who asks, as whoever let the request in found; else by its name alone."""
    caller = request.scope.get("state", {}).get("caller")
    return (
        caller if isinstance(caller, Caller) else Caller(client_name(request.headers.get("mastctl-client")))
    )


def _request_of(given: Mapping[str, Any]) -> dict[str, Any]:
    """What a request says in its path, its query and its body."""
    sent: dict[str, Any] = {}
    for name, value in given.items():
        if isinstance(value, BaseModel):
            sent |= value.model_dump(exclude_none=True)
        elif value is not None:
            sent[name] = value
    return sent


def _shorter(one_s: float | None, other_s: float | None) -> float | None:
    return min((time_s for time_s in (one_s, other_s) if time_s is not None), default=None)
