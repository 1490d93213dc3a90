"""Routes of the lease: who steers."""

from __future__ import annotations

import hashlib
from typing import Any

from fastapi import FastAPI

from mastctl.commands.caller import told_name
from mastctl.commands.entry import LEASE, LEASE_RELEASE, LEASE_RENEW, LEASE_TAKE
from mastctl.commands.lease import Lease, Leases
from mastctl.errors import BadRequest
from mastctl.web import PREFIX
from mastctl.web.commands import Came, Headers
from mastctl.web.models import LeaseBody, RenewBody, TakeBody
from mastctl.web.parts import Here


def add_lease(app: FastAPI) -> None:
    """Who steers: acquired, renewed, released, taken over."""

    @app.get(f"{PREFIX}/lease", summary="Who steers")
    async def control(here: Here) -> dict[str, Any]:
        return {"control": here.service.leases.told()}

    @app.post(f"{PREFIX}/lease", summary="Acquire the lease, if nobody else steers")
    async def acquire(body: LeaseBody, came: Headers, here: Here) -> dict[str, Any]:
        leases, name = here.service.leases, None if body.name is None else told_name(body.name)
        return await here.commands.run(
            LEASE,
            came,
            _told(body),
            lambda: _granted(
                leases,
                leases.acquire(came.caller, name, body.for_s, body.gives_way, body.ends_with_stop),
            ),
        )

    @app.post(f"{PREFIX}/lease/renew", summary="Have the lease run for its time from now on")
    async def renew(came: Headers, here: Here, body: RenewBody | None = None) -> dict[str, Any]:
        lease_id, for_s = _lease_of(came), None if body is None else body.for_s
        asked, leases = {"for_s": for_s, **_which(lease_id)}, here.service.leases
        return await here.commands.run(
            LEASE_RENEW, came, asked, lambda: _granted(leases, leases.renew(lease_id, for_s))
        )

    @app.delete(f"{PREFIX}/lease", summary="Release the lease")
    async def release(came: Headers, here: Here) -> dict[str, Any]:
        leases, lease_id = here.service.leases, _lease_of(came)

        def act() -> dict[str, Any]:
            leases.release(lease_id)
            return {"control": leases.told()}

        return await here.commands.run(LEASE_RELEASE, came, _which(lease_id), act)

    @app.post(f"{PREFIX}/lease/take", summary="Take over, whoever steers; what runs goes on")
    async def take(body: TakeBody, came: Headers, here: Here) -> dict[str, Any]:
        leases, name = here.service.leases, None if body.name is None else told_name(body.name)
        return await here.commands.run(
            LEASE_TAKE,
            came,
            _told(body),
            lambda: _granted(leases, leases.take(came.caller, body.reason, name, body.for_s)),
        )


def _granted(leases: Leases, lease: Lease) -> dict[str, Any]:
    told = leases.told_of(lease)
    return {"lease_id": lease.id, **{key: told[key] for key in ("holder", "for_s", "until")}}


def _told(body: LeaseBody | TakeBody) -> dict[str, Any]:
    return body.model_dump(exclude_none=True)


def _which(lease_id: str) -> dict[str, str]:
    """What tells a lease from another in the record, without being it: a key that came with one is not good
    for the next."""
    return {"of": hashlib.sha256(lease_id.encode()).hexdigest()[:16]}


def _lease_of(came: Came) -> str:
    """The lease that a request speaks of. Raises BadRequest."""
    if came.lease is None:
        raise BadRequest("bad_request", "Mastctl-Lease is missing; the id of the lease is expected")
    return came.lease
