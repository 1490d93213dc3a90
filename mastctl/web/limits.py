"""Routes of the jog, and of what the head must not look into."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI

from mastctl.service.service import Service
from mastctl.web import PREFIX
from mastctl.web.models import JogBody, SunBody
from mastctl.web.waiting import Waiting


def add_limits(app: FastAPI, service: Service, waiting: Waiting) -> None:
    """The jog, and the sun."""
    door = service.devices.door

    @app.post(f"{PREFIX}/jog", summary="A heartbeat: turn the head at a rate, for half a second")
    async def jog(body: JogBody) -> dict[str, Any]:
        return await waiting.run(lambda: service.jogs.beat(body.beat()))

    @app.get(f"{PREFIX}/limits/sun", summary="The direction that no head camera looks into")
    async def sun() -> dict[str, Any]:
        return door.told()

    @app.post(f"{PREFIX}/limits/sun", summary="Say where the sun stands; the head keeps off it")
    async def tell(body: SunBody) -> dict[str, Any]:
        came = body.sun(service.clock.now_s())
        await waiting.run(lambda: door.use_sun(came))
        return door.told()

    @app.delete(f"{PREFIX}/limits/sun", summary="Keep the head off no sun any more")
    async def forget() -> dict[str, Any]:
        await waiting.run(lambda: door.use_sun(None))
        return door.told()
