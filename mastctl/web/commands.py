"""How a request becomes a command: who asks, by which headers, and in whose thread it is carried out."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from typing import Annotated, Any, TypeVar

from fastapi import Depends, Header, Request

from mastctl.commands.caller import Caller, told_name
from mastctl.commands.entry import Asked, Command
from mastctl.commands.idempotency import Answer
from mastctl.errors import Unable
from mastctl.safety.stop_threads import StopsHang
from mastctl.service.service import Service
from mastctl.web.models import DeadlineS
from mastctl.web.waiting import Waiting

T = TypeVar("T")

STOP_ANSWER_S = 3.0  # the devices give a stop 1 s; beyond this it is told that nothing is known
NOTHING: Mapping[str, Any] = {}


class Came:
    """What the headers of a request for a command say; a dependency of its route."""

    def __init__(
        self, request: Request, lease: str | None, key: str | None, deadline_s: float | None
    ) -> None:
        self.caller = caller_of(request)
        self.lease = lease
        self.key = key
        self.deadline_s = deadline_s
        self._state: dict[str, Any] = request.scope.setdefault("state", {})

    def recorded(self) -> None:
        """Say that whatever comes of it is recorded as a command."""
        self._state["recorded"] = True


async def _came(
    request: Request,
    mastctl_client: Annotated[
        str | None, Header(description="What the program that asks calls itself")
    ] = None,
    mastctl_lease: Annotated[str | None, Header(description="The id of the lease that it holds")] = None,
    idempotency_key: Annotated[
        str | None, Header(description="The same for each try of one command, which is carried out once")
    ] = None,
    deadline_s: Annotated[
        DeadlineS | None, Header(description="How long the command is given, seconds")
    ] = None,
) -> Came:
    return Came(request, mastctl_lease, idempotency_key, deadline_s)


Headers = Annotated[Came, Depends(_came)]


def caller_of(request: Request) -> Caller:
    """Return who asks, as whoever let the request in found; else by its name alone."""
    caller = request.scope.get("state", {}).get("caller")
    return caller if isinstance(caller, Caller) else Caller(told_name(request.headers.get("mastctl-client")))


class Commands:
    """The commands of one daemon's routes; used on its event loop only.

    Parameters
    ----------
    service
        Carries them out, through its entry.
    waiting
        Runs what may wait.
    """

    def __init__(self, service: Service, waiting: Waiting) -> None:
        self._service = service
        self._waiting = waiting

    async def run(
        self,
        command: Command,
        came: Came,
        request: Mapping[str, Any],
        act: Callable[[], Answer],
        usual_s: float | None = None,
    ) -> Answer:
        """Return the answer of a command, carried out in a worker thread.

        Parameters
        ----------
        command
            Its kind.
        came
            The request's headers.
        request
            What is asked, as JSON; a ``deadline_s`` in it counts as the header does, the shorter of both.
        act, usual_s
            As `mastctl.commands.entry.Entry.run`, whose refusals this raises too.
        """
        asked = self._asked(came, request)
        return await self._waiting.run(lambda: self._service.entry.run(command, asked, act, usual_s))

    async def run_beside(self, command: Command, came: Came, act: Callable[[], Answer]) -> Answer:
        """Return the answer of a command that stops something: as `run`, in the stops' own threads, and each
        try is carried out."""
        asked = self._asked(came, NOTHING, keyed=False)
        return await stopped(self._service, lambda: self._service.entry.run(command, asked, act))

    async def first(
        self,
        command: Command,
        request: Request,
        act: Callable[[], Answer],
        told: Mapping[str, Any] = NOTHING,
    ) -> Answer:
        """Return the answer of a stop: nothing is asked and no header is judged before it acts."""
        asked = Asked(caller_of(request), request=told, lease=request.headers.get("mastctl-lease"))
        entry = self._service.entry
        try:
            return await stopped(self._service, lambda: entry.first(command, asked, act))
        except StopsHang as error:
            entry.not_begun(command, asked, error)
            raise

    def _asked(self, came: Came, request: Mapping[str, Any], keyed: bool = True) -> Asked:
        times_s = [time_s for time_s in (came.deadline_s, request.get("deadline_s")) if time_s is not None]
        asked = Asked(
            came.caller,
            self._service.clock.now_s(),
            request,
            came.lease,
            came.key if keyed else None,
            min(times_s, default=None),
            self._service.leases.last_stop,
        )
        came.recorded()
        return asked


async def stopped(service: Service, stop: Callable[[], T]) -> T:
    """Run a stop in the threads that are there for it. Raises Unable ``stop_pending``, DriverError."""
    try:
        return await asyncio.wait_for(asyncio.wrap_future(service.stop_threads.submit(stop)), STOP_ANSWER_S)
    except TimeoutError:
        words = f"the stop did not come back within {STOP_ANSWER_S:g} s; the head may still move"
        raise Unable("stop_pending", words) from None
