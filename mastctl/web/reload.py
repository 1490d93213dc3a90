"""The route by which the configuration is read again."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI

from mastctl.commands.entry import RELOAD
from mastctl.service.reload import reload
from mastctl.web import PREFIX
from mastctl.web.commands import Headers
from mastctl.web.parts import Here


def add_reload(app: FastAPI) -> None:
    """``POST /reload``."""

    @app.post(
        f"{PREFIX}/reload", summary="Read the configuration again: all of it comes into use, or nothing"
    )
    async def read_again(came: Headers, here: Here) -> dict[str, Any]:
        def act() -> dict[str, Any]:
            return reload(here.service)

        return await here.commands.run(RELOAD, came, {}, act)
