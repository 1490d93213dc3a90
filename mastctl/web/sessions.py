"""Routes of who asks: a page's log-in and log-out, and what a caller may do."""

from __future__ import annotations

from fastapi import FastAPI, Request, Response

from mastctl.answers import LoggedOut, Role, SessionTold
from mastctl.control.caller import Caller
from mastctl.errors import NotNow
from mastctl.http import PREFIX
from mastctl.http.access import SESSION_S
from mastctl.http.entrance import address_of, cookie_name, credentials
from mastctl.web.models import LoginBody
from mastctl.web.parts import Here


def add_sessions(app: FastAPI) -> None:
    """Log-in, log-out, and who one is."""

    @app.get(f"{PREFIX}/session", summary="The client's name and rights")
    async def session(request: Request, here: Here) -> SessionTold:
        access = here.entrance.access
        caller: Caller = request.scope["state"]["caller"]
        shown = credentials(request.scope, request.headers)
        held = None
        if access is not None and shown.token is None and shown.session is not None:
            held = access.session_of(shown.session)
        left_s = None if held is None else held[1]
        return _told(caller.name, caller.role, caller.via, left_s, access is not None)

    @app.post(f"{PREFIX}/login", summary="Begin a page's session by a token")
    async def login(body: LoginBody, request: Request, response: Response, here: Here) -> SessionTold:
        access = here.entrance.access
        if access is None:
            raise NotNow("no_login", "no token is needed here: the daemon serves this machine only")
        secret, token, _ = access.log_in(body.token, address_of(request.scope))
        response.set_cookie(
            cookie_name(request.scope),
            secret,
            max_age=int(SESSION_S),
            path="/",
            secure=here.entrance.names.secure,
            httponly=True,
            samesite="strict",
        )
        return _told(token.name, token.role, "token", SESSION_S, True)

    @app.post(f"{PREFIX}/logout", summary="End a page's session")
    async def logout(request: Request, response: Response, here: Here) -> LoggedOut:
        access, secure = here.entrance.access, here.entrance.names.secure
        shown = credentials(request.scope, request.headers)
        if access is not None and shown.session is not None:
            access.log_out(shown.session)
        name = cookie_name(request.scope)
        response.delete_cookie(name, path="/", secure=secure, httponly=True, samesite="strict")
        return {"logged_out": True}


def _told(name: str, role: Role, via: str, ends_in_s: float | None, needs_token: bool) -> SessionTold:
    return {"name": name, "role": role, "via": via, "ends_in_s": ends_in_s, "needs_token": needs_token}
