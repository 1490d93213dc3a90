"""Every refusal in the one form, its HTTP status and sentence, and the headers that every answer carries."""

from __future__ import annotations

import json
import math
from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
from contextlib import asynccontextmanager
from typing import Any, TypeVar, get_args

from fastapi import FastAPI, Request, WebSocket
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.routing import APIRoute
from pydantic import BaseModel, ValidationError
from starlette.exceptions import HTTPException

from calib.errors import CalibError
from calib.files.yaml_text import nearest
from drivers.errors import BadOptions, DriverError, NoFreshFrame, NoReply
from mastctl.as_json import as_json
from mastctl.errors import (
    BadRequest,
    MastctlError,
    NoLonger,
    NotAllowed,
    NotKnown,
    NotLetIn,
    NotNow,
    Unable,
    error_body,
)

HEADERS: Mapping[str, str] = {
    "cache-control": "no-store",
    "x-content-type-options": "nosniff",
    "cross-origin-resource-policy": "same-origin",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
}
NO_PAGE = "default-src 'none'; frame-ancestors 'none'"
"""The Content-Security-Policy of what is no page: opened by itself it may do nothing."""
PAGE = (
    "default-src 'self'; img-src 'self' blob: data:; object-src 'none'; base-uri 'none'; "
    "form-action 'self'; frame-ancestors 'none'"
)
"""The Content-Security-Policy of a page: its own files only, no script inside it, in no frame."""

RENAMED = {"goes_on": "resume"}
"""Keys of bodies by their names before version 0.1."""

Headers = list[tuple[bytes, bytes]]
Query = TypeVar("Query", bound=BaseModel)


class GuardError(Exception):
    """A request that does not get as far as the API."""

    def __init__(
        self, status: int, code: str, message: str, headers: Mapping[str, str] | None = None
    ) -> None:
        self.status = status
        self.code = code
        self.headers = dict(headers or {})
        super().__init__(message)


class JsonAnswer(JSONResponse):
    """JSON; what it has no place for (no finite number, a name that is no UTF-8) as `as_json` has it."""

    def render(self, content: Any) -> bytes:
        """Return the bytes of an answer."""
        try:
            return super().render(content)
        except ValueError:
            return super().render(as_json(content))


def error_response(
    status: int, code: str, message: str, detail: Any = None, headers: Mapping[str, str] | None = None
) -> JSONResponse:
    """Return an error in the one form of docs/reference/http.md."""
    body = {"error": {"code": code, "message": message, "detail": detail}}
    all_headers = {**HEADERS, "content-security-policy": NO_PAGE, **(headers or {})}
    return JsonAnswer(body, status_code=status, headers=all_headers)


@asynccontextmanager
async def query_of(line: WebSocket, model: type[Query], listed: str) -> AsyncIterator[Query]:
    """Yield a WebSocket's query, read as that of a route; ``listed`` may stand in it more than once.

    A wrong query is refused on the line, and so is what the block refuses before it accepts.
    """
    given = line.query_params
    query: dict[str, Any] = {name: given[name] for name in given if name != listed}
    try:
        yield model.model_validate(query | ({listed: given.getlist(listed)} if listed in given else {}))
    except ValidationError as error:
        first = error.errors()[0]
        message = sentence({**first, "loc": ("query", *first["loc"])}, model)
        await line.send_denial_response(error_response(422, "bad_request", message))
    except MastctlError as error:
        await line.send_denial_response(refusal_response(error))


def marked(headers: Iterable[tuple[bytes, bytes]]) -> Headers:
    """Return an answer's headers with those of every answer that it does not have already."""
    given = list(headers)
    names = {name.lower() for name, _ in given}
    kind = next((value for name, value in given if name.lower() == b"content-type"), b"")
    policy = PAGE if kind.startswith(b"text/html") else NO_PAGE
    wanted = {**HEADERS, "content-security-policy": policy}
    return given + [(n.encode(), v.encode()) for n, v in wanted.items() if n.encode() not in names]


def sentence(problem: Mapping[str, Any], model: object) -> str:
    """Return one validation problem of pydantic as a plain sentence: place, value, what is expected.

    Parameters
    ----------
    problem
        One entry of pydantic's list of errors.
    model
        The model of the body or the query, for its keys and for the description of what is expected; of a
        path, the parameter's own facts. None if not known.
    """
    where = tuple(str(step) for step in problem["loc"])
    place = _place(where)
    kind = problem["type"]
    message = str(problem["msg"])
    if kind == "value_error":
        return message.removeprefix("Value error, ")
    if kind == "missing":
        return f"{place} is missing" if len(where) > 1 else "the body is missing; a JSON object is expected"
    if kind in ("extra_forbidden", "unexpected_keyword_argument"):
        if new := RENAMED.get(where[-1]):
            return f"{place} is called {new} since version 0.1"
        known = _keys(model, where[1:-1])
        return f"{place}: unknown key; {nearest(where[-1], known)}" if known else f"{place}: unknown key"
    value = _short(problem.get("input"))
    if kind == "string_pattern_mismatch" and (expected := _described(model, where[1:])):
        return f"{place}: {value} where {expected} is expected"
    if kind in ("too_short", "too_long"):
        size = 4 if where[-1] == "quaternion" else 3
        return f"{place}: {value} where a list of {size} numbers is expected"
    if kind in ("model_attributes_type", "model_type", "dict_type", "dataclass_type"):
        return f"{place}: {value} where an object with keys is expected"
    for start in ("Input should be ", "String should have "):
        if message.startswith(start):
            expected = message.removeprefix(start).partition(", unable to")[0]
            return f"{place}: {value} where {expected} is expected"
    return f"{place}: {value}: {message}"


def _keys(model: object, place: Sequence[str]) -> list[str]:
    """The keys of a model or dataclass, or of the one at a place inside it."""
    for candidate in (model, *get_args(model)):
        fields = getattr(candidate, "model_fields", None) or getattr(candidate, "__pydantic_fields__", None)
        if fields is None:
            continue
        if not place:
            return list(fields)
        if place[0] in fields:
            return _keys(fields[place[0]].annotation, place[1:])
    return []


def _described(model: object, place: Sequence[str]) -> str | None:
    """What is expected at a place, by the description of the model, or of a path's parameter itself."""
    for candidate in (model, *get_args(model)):
        fields = getattr(candidate, "model_fields", None) or {}
        if place and place[0] in fields:
            return fields[place[0]].description or _described(fields[place[0]].annotation, place[1:])
    return getattr(model, "description", None)


def _place(where: tuple[str, ...]) -> str:
    """``("body", "position_m", "0")`` as ``position_m[0]``."""
    place = ""
    for step in where[1:]:
        place += f"[{step}]" if step.isdecimal() else f".{step}" if place else step
    return place[:120] or f"the {where[0]}"


def _short(value: Any) -> str:
    """A value as JSON, cut short."""
    try:
        text = json.dumps(value)
    except (TypeError, ValueError):
        text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


STATUS_OF_KIND: Mapping[type[Exception], int] = {
    BadRequest: 422,
    NotLetIn: 401,
    NotAllowed: 403,
    NotKnown: 404,
    NoLonger: 410,
    NotNow: 409,
    Unable: 503,
    MastctlError: 500,
    CalibError: 422,
    BadOptions: 422,
    NoReply: 504,
    NoFreshFrame: 504,
    DriverError: 502,
}


def status_of(error: Exception) -> int:
    """Return the HTTP status of an error's family, the nearest one above its class."""
    return next(STATUS_OF_KIND[kind] for kind in type(error).__mro__ if kind in STATUS_OF_KIND)


def refusal_response(error: Exception) -> JSONResponse:
    """Return the answer to a request that met an error of these families."""
    if isinstance(error, GuardError):
        return error_response(error.status, error.code, str(error), headers=error.headers)
    body, headers = error_body(error), {}
    again_s = getattr(error, "retry_after_s", None)
    if again_s is not None:
        headers["Retry-After"] = str(math.ceil(again_s))
    if isinstance(error, NotLetIn):
        headers["WWW-Authenticate"] = "Bearer"
    return error_response(status_of(error), body["code"], body["message"], body["detail"], headers)


def add_errors(app: FastAPI) -> None:
    """Every refusal in the one form."""

    async def ours(request: Request, error: Exception) -> JSONResponse:
        return refusal_response(error)

    for kind in (MastctlError, DriverError, CalibError, GuardError):
        app.add_exception_handler(kind, ours)

    @app.exception_handler(RequestValidationError)
    async def invalid(request: Request, error: RequestValidationError) -> JSONResponse:
        sentences = [sentence(problem, _read_by(request, problem)) for problem in error.errors()[:10]]
        return error_response(422, "bad_request", sentences[0], {"problems": sentences})

    @app.exception_handler(HTTPException)
    async def http(request: Request, error: HTTPException) -> JSONResponse:
        known = {
            404: ("not_found", f"there is nothing at {request.url.path[:120]}; see /openapi.json"),
            405: ("method_not_allowed", f"{request.method} is not possible at {request.url.path[:120]}"),
        }
        code, message = known.get(error.status_code, ("bad_request", str(error.detail)))
        headers = dict(error.headers or {})
        if error.status_code == 405:
            headers["Allow"] = ", ".join(_methods_of(app, request))
        return error_response(error.status_code, code, message, headers=headers)

    @app.exception_handler(Exception)
    async def defect(request: Request, error: Exception) -> JSONResponse:
        body = error_body(error)
        return error_response(500, body["code"], body["message"])


def _methods_of(app: FastAPI, request: Request) -> list[str]:
    """The methods of a path, which may have a route for each."""
    found = set[str]()
    for route in app.routes:
        if isinstance(route, APIRoute) and route.path_regex.match(request.url.path):
            found |= route.methods or set()
    return sorted(found)


def _read_by(request: Request, problem: Mapping[str, Any]) -> object:
    """The model by which the route reads its body or its query, wherever the problem is."""
    route = request.scope.get("route")
    if not isinstance(route, APIRoute):
        return None
    if problem["loc"][0] == "path":
        named = (one for one in route.dependant.path_params if one.name == problem["loc"][1])
        return next((one.field_info for one in named), None)
    params = route.dependant.body_params if problem["loc"][0] == "body" else route.dependant.query_params
    return params[0].field_info.annotation if params else None
