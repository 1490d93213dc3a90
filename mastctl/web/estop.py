"""Routes of the emergency stop and its release."""

from __future__ import annotations

import asyncio
import json
from typing import Any

from fastapi import FastAPI, Request

from mastctl.commands.entry import ESTOP, RESET
from mastctl.errors import Unable, one_line
from mastctl.safety.latch import LONGEST
from mastctl.safety.stop_threads import StopsHang
from mastctl.web import PREFIX
from mastctl.web.commands import Headers
from mastctl.web.models import EstopBody, ResetBody
from mastctl.web.parts import Here

BODY_S = 0.05  # a body comes with its request; who sends it later is stopped without its words
LARGEST_BODY_BYTES = 4096
ANY_BODY = {"anyOf": [EstopBody.model_json_schema(), {}]}  # a stop is refused for no body


def add_estop(app: FastAPI) -> None:
    """The emergency stop, which needs no body that makes sense, and the reset, which does."""

    @app.post(
        f"{PREFIX}/estop",
        summary="Stop the mast and let nothing move it until it is reset, across restarts too",
        openapi_extra={"requestBody": {"content": {"application/json": {"schema": ANY_BODY}}}},
    )
    async def estop(request: Request, here: Here) -> dict[str, Any]:
        told = await _told(request)
        words = told.get("reason"), told.get("name")
        stopping = here.service.stopping
        try:
            return await here.commands.first(
                ESTOP, request, lambda: stopping.estop(*words), {"reason": words[0], "name": words[1]}
            )
        except StopsHang as error:
            await here.waiting.run(lambda: stopping.latch_estop(*words))
            raise Unable("stop_unconfirmed", f"the emergency stop is latched, but {error}") from None

    @app.post(f"{PREFIX}/reset", summary="Release an emergency stop; nothing moves before the next command")
    async def reset(body: ResetBody, came: Headers, here: Here) -> dict[str, Any]:
        def act() -> dict[str, Any]:
            return here.service.stopping.reset(body.reason, body.name, body.of)

        return await here.commands.run(RESET, came, body.model_dump(), act)


async def _told(request: Request) -> dict[str, str]:
    """What words the body has, if it comes at once and has any."""
    data = b""
    try:
        async with asyncio.timeout(BODY_S):
            async for part in request.stream():
                data += part
                if len(data) > LARGEST_BODY_BYTES:
                    return {}
        found = json.loads(data)
    except Exception:  # late, broken off, no JSON: a stop is not refused for its words
        return {}
    return (
        {key: one_line(value, LONGEST) for key, value in found.items() if isinstance(value, str)}
        if isinstance(found, dict)
        else {}
    )
