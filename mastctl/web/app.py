"""The HTTP interface (docs/reference/http.md): JSON under /api/v1, described by /openapi.json.

The event loop only reads snapshots. Whatever takes a lock, a file or a device runs in worker threads
(`mastctl.http.waiting`); ``POST /stop`` has threads of its own, so that it never waits behind them.
Every refusal is ``{"error": {"code", "message", "detail"}}``.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from typing import Annotated, Any, Literal, Union

from fastapi import FastAPI, Request, Response
from fastapi.responses import JSONResponse
from fastapi.routing import APIRoute
from fastapi.utils import create_model_field
from pydantic import BaseModel, Field, TypeAdapter, create_model
from starlette.types import ASGIApp, Receive, Scope, Send
from typing_extensions import get_type_hints, is_typeddict

from mastctl import answers
from mastctl.answers import EVENT_VALUES, WELL, Count, ErrorBody
from mastctl.errors import Unable
from mastctl.http import PREFIX
from mastctl.http.guard import Guard, cookie_name, from_this_machine, shown_token
from mastctl.http.refusals import JsonAnswer, add_errors
from mastctl.service.metrics import CONTENT_TYPE
from mastctl.web.commands import REFERENCE, Here, Parts, caller_of, file_of
from mastctl.web.events import add_events
from mastctl.web.images import add_cameras, add_images
from mastctl.web.keeping import add_bench, add_masts, add_places, add_recordings
from mastctl.web.page import add_page, add_site
from mastctl.web.panorama import add_panoramas, add_targets
from mastctl.web.simulation import add_simulation
from mastctl.web.steering import add_estop, add_lease, add_limits, add_pointing, add_tracking

COOKIE_S = 12 * 3600


def create_app(parts: Parts) -> ASGIApp:
    """Return the ASGI application that serves one service."""
    routes = api()

    async def served(scope: Scope, receive: Receive, send: Send) -> None:
        scope.setdefault("state", {})["parts"] = parts
        await routes(scope, receive, send)

    return Guard(served, parts.entrance, parts.waiting, parts.service.entry)


class _Route(APIRoute):
    """A route whose answer goes out as it is made; its type is for the type checker and the description."""

    def __init__(self, path: str, endpoint: Callable[..., Any], **options: Any) -> None:
        if is_typeddict(get_type_hints(endpoint).get("return")):
            options["response_model"] = dict[str, Any]
        super().__init__(path, endpoint, **options)


@cache
def api() -> FastAPI:
    """Return the routes. They hold nothing of any daemon; making them takes 0.1 s, so once a process."""
    app = FastAPI(
        title="mastctl",
        version=version("mastctl"),
        description="A rover mast: state, pointing with a measured residual, pictures with their facts.",
        responses={status: {"model": ErrorBody, "description": "Refused"} for status in ("4XX", "5XX", 422)},
        default_response_class=JsonAnswer,
        openapi_url=None,  # served by a route of our own, which does not make it on the event loop
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
    )
    app.router.route_class = _Route
    add_errors(app)
    for add in (
        *(add_sessions, add_pointing, add_estop, add_lease, add_tracking, add_limits, add_masts, add_places),
        *(add_recordings, add_bench, add_simulation, add_health, add_events, add_images, add_page),
        *(add_cameras, add_panoramas, add_targets, add_site),
    ):
        add(app)

    @app.get("/openapi.json", include_in_schema=False)
    async def document(here: Here) -> Response:
        return Response(await here.waiting.run(lambda: description(app)), media_type="application/json")

    return app


def add_health(app: FastAPI) -> None:
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
    caller, needs_token = caller_of(request), here.entrance.access is not None
    return {"name": caller.name, "role": caller.role, "via": caller.via, "needs_token": needs_token}


_ONE_MAKES_IT = threading.Lock()


def description(app: FastAPI) -> bytes:
    """Return /openapi.json: FastAPI's description of the routes, with the types of their answers.

    The first call takes 0.2 s, too long for the event loop, on which a stop would wait.
    """
    with _ONE_MAKES_IT:
        return _made(app)


@cache
def _made(app: FastAPI) -> bytes:
    for route in app.routes:
        if isinstance(route, APIRoute) and route.include_in_schema:
            kind: Any = get_type_hints(route.endpoint).get("return")
            if is_typeddict(kind):
                route.response_field = create_model_field(kind.__name__, kind, mode="serialization")
                route.response_description = (kind.__doc__ or kind.__name__).strip().splitlines()[0]
    document = app.openapi()
    events = [_event(topic, kind) for topic, kind in EVENT_VALUES.items()]
    event: Any = Annotated[Union[*events], Field(discriminator="topic")]
    schema = TypeAdapter(event).json_schema(mode="serialization", ref_template=REFERENCE)
    document["components"]["schemas"] |= schema.pop("$defs", {}) | {"Event": schema}
    return bytes(JSONResponse(document).body)


def _event(topic: str, kind: Any) -> type[BaseModel]:
    """The model of a topic's events, by `mastctl.answers.Event`."""
    count = (Count, ...)
    fields: dict[str, Any] = {"topic": (Literal[topic], ...), "key": (str, ...), "sequence": count}
    return create_model(f"{topic.title()}Event", **fields, lost=count, value=(kind, ...))
