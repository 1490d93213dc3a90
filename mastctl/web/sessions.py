"""Routes of the caller: its name and rights, and the cookie in which a page keeps its token."""

from __future__ import annotations

from fastapi import FastAPI, Request, Response

from mastctl.answers import ClientSession
from mastctl.control.lease import Caller
from mastctl.http import PREFIX
from mastctl.http.guard import cookie_name, shown_token
from mastctl.web.parts import Here

COOKIE_S = 12 * 3600


def add_sessions(app: FastAPI) -> None:
    """The caller, and its cookie."""

    @app.get(f"{PREFIX}/session", summary="The client's name and rights")
    async def session(request: Request, here: Here) -> ClientSession:
        return _session(request, here)

    @app.post(f"{PREFIX}/session", summary="Keep the token of this request in the page's cookie")
    async def keep(request: Request, response: Response, here: Here) -> ClientSession:
        token, _ = shown_token(request.scope, request.headers)
        if here.entrance.access is not None and token is not None:
            response.set_cookie(
                cookie_name(request.scope),
                token,
                max_age=COOKIE_S,
                path="/",
                secure=request.headers.get("origin", "").startswith("https:"),
                httponly=True,
                samesite="strict",
            )
        return _session(request, here)

    @app.delete(f"{PREFIX}/session", summary="Forget the page's cookie")
    async def forget(request: Request, response: Response, here: Here) -> ClientSession:
        response.delete_cookie(cookie_name(request.scope), path="/", httponly=True, samesite="strict")
        return _session(request, here)


def _session(request: Request, here: Here) -> ClientSession:
    caller: Caller = request.scope["state"]["caller"]
    needs_token = here.entrance.access is not None
    return {"name": caller.name, "role": caller.role, "via": caller.via, "needs_token": needs_token}
