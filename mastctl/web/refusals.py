"""Every refusal in the one form, with the HTTP status that fits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.routing import APIRoute
from starlette.exceptions import HTTPException

from calib.errors import CalibError
from drivers.errors import BadOptions, DriverError, NoFreshFrame, NoReply
from mastctl.errors import (
    BadRequest,
    MastctlError,
    NoLonger,
    NotAllowed,
    NotKnown,
    NotLetIn,
    NotNow,
    TooMany,
    Unable,
    error_body,
)
from mastctl.web.answer import GuardError, error_response
from mastctl.web.sentences import sentence

STATUS_OF_KIND: Mapping[type[Exception], int] = {
    BadRequest: 422,
    NotLetIn: 401,
    NotAllowed: 403,
    TooMany: 429,
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


def told(error: Exception) -> JSONResponse:
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
        return told(error)

    for kind in (MastctlError, DriverError, CalibError, GuardError):
        app.add_exception_handler(kind, ours)

    @app.exception_handler(RequestValidationError)
    async def invalid(request: Request, error: RequestValidationError) -> JSONResponse:
        sentences = [sentence(problem, _read_by(request, problem)) for problem in error.errors()[:10]]
        return error_response(422, "bad_request", sentences[0], {"problems": sentences})

    @app.exception_handler(HTTPException)
    async def http(request: Request, error: HTTPException) -> JSONResponse:
        words = {
            404: ("not_found", f"there is nothing at {request.url.path[:120]}; see /openapi.json"),
            405: ("method_not_allowed", f"{request.method} is not possible at {request.url.path[:120]}"),
        }
        code, message = words.get(error.status_code, ("bad_request", str(error.detail)))
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
