"""Routes of the jog, and of what the head must not look into."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI

from mastctl.commands.entry import JOG, SUN, SUN_FORGET
from mastctl.service.service import Service
from mastctl.web import PREFIX
from mastctl.web.commands import Headers
from mastctl.web.models import JogBody, SunBody
from mastctl.web.parts import Here


def add_limits(app: FastAPI) -> None:
    """The jog, and the sun."""

    @app.post(f"{PREFIX}/jog", summary="A heartbeat: turn the head at a rate, for half a second")
    async def jog(body: JogBody, came: Headers, here: Here) -> dict[str, Any]:
        asked, beat, jogs = body.model_dump(exclude_none=True), body.beat(), here.service.jogs
        with jogs.heard(beat) as may_begin:
            return await here.commands.run(JOG, came, asked, lambda: jogs.beat(beat, may_begin))

    @app.get(f"{PREFIX}/limits/sun", summary="The direction that no head camera looks into")
    async def sun(here: Here) -> dict[str, Any]:
        return here.service.devices.door.told()

    @app.post(f"{PREFIX}/limits/sun", summary="Say where the sun stands; the head keeps off it")
    async def tell(body: SunBody, came: Headers, here: Here) -> dict[str, Any]:
        service = here.service
        door, sun = service.devices.door, body.sun(service.clock.now_s())

        def act() -> dict[str, Any]:
            door.use_sun(sun)
            stop_before_keep_outs(service)
            return door.told()

        return await here.commands.run(SUN, came, body.model_dump(exclude_none=True), act)

    @app.delete(f"{PREFIX}/limits/sun", summary="Keep the head off no sun any more")
    async def forget(came: Headers, here: Here) -> dict[str, Any]:
        door = here.service.devices.door

        def act() -> dict[str, Any]:
            door.use_sun(None)
            return door.told()

        return await here.commands.run(SUN_FORGET, came, {}, act)


def stop_before_keep_outs(service: Service) -> None:
    """Stop a head that is under way into what has come to be kept out. Raises DriverError."""
    name = service.devices.door.in_the_way(service.devices.last_reading)
    if name is not None:
        service.operations.stop(f"the keep-out {name} came to lie in the head's way")
