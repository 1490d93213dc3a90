"""Routes of the caller itself, and for programs that watch a daemon: Prometheus, health checks."""

from __future__ import annotations

from fastapi import FastAPI, Request, Response

from mastctl import answers
from mastctl.answers import WELL
from mastctl.control.lease import Caller
from mastctl.errors import Unable
from mastctl.http import PREFIX
from mastctl.http.guard import cookie_name, from_this_machine, shown_token
from mastctl.service.metrics import CONTENT_TYPE
from mastctl.web.commands import Here, caller_of, file_of

COOKIE_S = 12 * 3600


def add_watching(app: FastAPI) -> None:
    """Metrics, health, that of the calibration, and the drift sentinel's findings."""

    @app.get(
        "/metrics",
        summary="Figures in the text format of Prometheus",
        response_class=Response,
        responses=file_of("text/plain"),
    )
    async def metrics(here: Here) -> Response:
        text = await here.waiting.run(here.service.metrics.text)  # it reads /proc
        return Response(text, media_type=CONTENT_TYPE)

    @app.get(f"{PREFIX}/health/live", summary="Whether requests are answered: they are")
    async def live(request: Request, here: Here) -> answers.LiveAnswer:
        access = here.entrance.access
        if access is None or not from_this_machine(request):
            return {"live": True}
        return {"live": True, "token_folder": access.folder}

    @app.get(
        f"{PREFIX}/health/ready",
        summary="Whether commands are carried out: 200 if they are, else 503 and why not",
    )
    async def ready(request: Request, here: Here) -> answers.ReadyAnswer:
        now = here.service.machine.standing
        reason = "" if caller_of(request).stranger else now.reason  # it may name a person
        if now.state not in WELL:
            raise Unable("not_ready", f"{now.state}: {reason}" if reason else now.state)
        return {"ready": True, "state": now.state, "reason": reason}

    @app.get(
        f"{PREFIX}/calibration/health",
        summary="Whether the mast file still holds, with the figures of the last days' residuals",
    )
    async def calibration(here: Here) -> answers.CalibrationReport:
        return here.service.drift.report()

    @app.get(f"{PREFIX}/sentinel", summary="The findings of the drift sentinel, and the age of its last look")
    async def sentinel(here: Here) -> answers.SentinelAnswer:
        return here.service.drift.pictures


def add_sessions(app: FastAPI) -> None:
    """The caller, and its cookie."""

    @app.get(f"{PREFIX}/session", summary="The client's name and rights")
    async def session(request: Request, here: Here) -> answers.ClientSession:
        return _session(request, here)

    @app.post(f"{PREFIX}/session", summary="Keep the token of this request in the page's cookie")
    async def keep(request: Request, response: Response, here: Here) -> answers.ClientSession:
        token = shown_token(request)
        if here.entrance.access is not None and token is not None:
            response.set_cookie(
                cookie_name(request),
                token,
                max_age=COOKIE_S,
                path="/",
                secure=request.headers.get("origin", "").startswith("https:"),
                httponly=True,
                samesite="strict",
            )
        return _session(request, here)

    @app.delete(f"{PREFIX}/session", summary="Forget the page's cookie")
    async def forget(request: Request, response: Response, here: Here) -> answers.ClientSession:
        response.delete_cookie(cookie_name(request), path="/", httponly=True, samesite="strict")
        return _session(request, here)


def _session(request: Request, here: Here) -> answers.ClientSession:
    caller: Caller = request.scope["state"]["caller"]
    needs_token = here.entrance.access is not None
    return {"name": caller.name, "role": caller.role, "via": caller.via, "needs_token": needs_token}
