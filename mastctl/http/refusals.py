"""Every refusal in the one form, its HTTP status and sentence, and the headers that every answer carries."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Annotated, Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError, WebSocketRequestValidationError
from fastapi.requests import HTTPConnection
from fastapi.responses import JSONResponse
from pydantic.fields import FieldInfo
from starlette.exceptions import HTTPException
from starlette.routing import Match

from calib.errors import CalibError
from calib.files.records import mistakes_in, schema_of
from calib.files.yaml_text import kind_of
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
    one_line,
)

HEADERS: Mapping[str, str] = {
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
"""That of the page: its own files only, no script inside it, in no frame."""
SITE = f"{PAGE}; script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'"
"""That of the documentation, whose theme has scripts and styles inside its pages."""

Headers = list[tuple[bytes, bytes]]


class JsonAnswer(JSONResponse):
    """JSON; what it has no place for (no finite number, a name that is no UTF-8) as `as_json` has it."""

    def render(self, content: Any) -> bytes:
        try:
            return super().render(content)
        except ValueError:
            return super().render(as_json(content))


def error_response(
    status: int, code: str, message: str, detail: Any = None, headers: Mapping[str, str] | None = None
) -> JSONResponse:
    """Return an error in the one form of docs/reference/http.md."""
    body = {"error": {"code": code, "message": message, "detail": detail}}
    return JsonAnswer(body, status_code=status, headers=headers)


def marked(headers: Iterable[tuple[bytes, bytes]], policy: str, keep: str) -> Headers:
    """Return an answer's headers with those of every answer that it does not have already.

    ``policy`` is its Content-Security-Policy, ``keep`` its Cache-Control.
    """
    given = list(headers)
    names = {name.lower() for name, _ in given}
    wanted = {**HEADERS, "content-security-policy": policy, "cache-control": keep}
    return given + [(n.encode(), v.encode()) for n, v in wanted.items() if n.encode() not in names]


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
    """Return the HTTP status of an error's family, the nearest one above its class; 500 of a defect."""
    return next((STATUS_OF_KIND[kind] for kind in type(error).__mro__ if kind in STATUS_OF_KIND), 500)


def refusal_response(error: Exception) -> JSONResponse:
    """Return the answer to a request that met an error."""
    body, headers = error_body(error), {}
    again_s = getattr(error, "retry_after_s", None)
    if again_s is not None:
        headers["Retry-After"] = str(math.ceil(again_s))
    if isinstance(error, NotLetIn):
        headers["WWW-Authenticate"] = "Bearer"
    return error_response(status_of(error), body["code"], body["message"], body["detail"], headers)


def add_errors(app: FastAPI) -> None:
    """Every refusal in the one form, of a WebSocket's request too."""

    async def ours(line: HTTPConnection, error: Exception) -> JSONResponse:
        return refusal_response(error)

    for kind in (MastctlError, DriverError, CalibError, Exception):
        app.add_exception_handler(kind, ours)

    async def invalid(line: HTTPConnection, error: Any) -> JSONResponse:
        first = error.errors()[0]
        if first["type"] == "json_invalid":
            return error_response(400, "not_json", f"the body is not JSON: {first['ctx']['error']}")
        if first["loc"] == ("body",) and isinstance(first["input"], bytes):
            kind = one_line(line.headers.get("content-type", ""), 60)
            message = f"Content-Type is '{kind}' where application/json is expected"
            return error_response(415, "not_json", message)
        found = _sentences(line, error.errors()[:10])
        return error_response(422, "bad_request", found[0], {"problems": found})

    app.add_exception_handler(RequestValidationError, invalid)
    app.add_exception_handler(WebSocketRequestValidationError, invalid)

    @app.exception_handler(HTTPException)
    async def http(request: Request, error: HTTPException) -> JSONResponse:
        path = request.url.path[:120]
        code, message = {
            400: ("not_json", "the body cannot be read as JSON"),
            404: ("not_found", f"there is nothing at {path}; see /openapi.json"),
            405: ("method_not_allowed", f"{request.method} is not possible at {path}"),
            413: ("too_large", error.detail),
        }.get(error.status_code, ("bad_request", error.detail))
        headers = dict(error.headers or {})
        if error.status_code == 405:  # the router names those of its first route at the path alone
            matching = [one for one in app.routes if one.matches(request.scope)[0] is not Match.NONE]
            methods = {method for one in matching for method in getattr(one, "methods", None) or ()}
            headers |= {"Allow": ", ".join(sorted(methods))} if methods else {}
        return error_response(error.status_code, code, message, headers=headers)


def _sentences(line: HTTPConnection, errors: Sequence[Any]) -> list[str]:
    """What is wrong with the part of a request whose error comes first."""
    if errors[0]["loc"] == ("body",) and errors[0].get("input") is None:
        return ["the request has no body where a JSON object is expected"]
    part = errors[0]["loc"][0]
    inside = [{**one, "loc": one["loc"][1:]} for one in errors if one["loc"][0] == part]
    dependant = line.scope["route"].dependant
    if part in ("body", "query"):
        params = dependant.body_params if part == "body" else dependant.query_params
        whole = not inside[0]["loc"] and inside[0]["type"] != "value_error"
        schema = schema_of(params[0].field_info.annotation, "")
        found = mistakes_in(inside, schema, f"the {part}" if whole else "")
        return [f"{place[:120]}: {reason}" if place else reason for place, reason in found]
    known = {
        one.alias: one.field_info
        for each in (dependant, *dependant.dependencies)
        for one in (*each.path_params, *each.header_params)
    }
    return [_of_parameter(one, known[one["loc"][0]]) for one in inside]


def _of_parameter(error: Mapping[str, Any], facts: FieldInfo) -> str:
    """What is wrong with a parameter; of a name's pattern only the description says what is right."""
    name = error["loc"][0]
    if error["type"] == "string_pattern_mismatch":
        return f"{name}: {kind_of(error['input'])} where {facts.description} is expected"
    schema = schema_of(Annotated[facts.annotation, facts], "")
    given = error["input"]
    if isinstance(given, str) and not error["type"].startswith("string"):
        with suppress(ValueError):  # the number that a header's text is, if it is one
            given = float(given)
    ((place, reason),) = mistakes_in([{**error, "loc": (), "input": given}], schema, name)
    return f"{place}: {reason}"
