"""Every refusal in the one form, with the HTTP status that fits."""

from __future__ import annotations

import math
from collections.abc import Mapping

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from calib.errors import CalibError
from drivers.errors import BadFrame, BadOptions, BadReply, DriverError
from mastctl.devices.limits import OutsideLimits
from mastctl.errors import MastctlError
from mastctl.operations import error_body
from mastctl.web import PREFIX
from mastctl.web.guard import error_response
from mastctl.web.models import sentence

STATUS_OF_CODE: Mapping[str, int] = {
    "busy": 409,
    "moving": 409,
    "no_former_mast": 409,
    "no_pose_before": 409,
    "no_track": 409,
    "pose_runs_backwards": 409,
    "rover_moved": 409,
    "stopped": 409,
    "stopping": 409,
    "frame_moving": 409,
    "other_mast_file": 409,
    "frame_too_old": 410,
    "frame_unknown": 404,
    "operation_unknown": 404,
    "unknown_camera": 404,
    "not_simulated": 404,
    "bad_aim": 422,
    "bad_mast_file": 422,
    "no_stereo": 422,
    "outside_image": 422,
    "outside_limits": 422,
    "pose_without_covariance": 422,
    "pose_without_time": 422,
    "wrong_camera": 422,
    "failed": 503,
    "closing": 503,
    "no_thread": 503,
    "stop_pending": 503,
    "too_many": 503,
}


def status_of(error: Exception) -> int:
    """Return the HTTP status that fits an error."""
    code = getattr(error, "code", "")
    if isinstance(error, (BadOptions, OutsideLimits, CalibError)):
        return 422
    if isinstance(error, (BadReply, BadFrame)):
        return 502
    if isinstance(error, DriverError):
        return 504 if code in ("no_reply", "no_fresh_frame") else 502
    return STATUS_OF_CODE.get(code, 500)


def add_errors(app: FastAPI) -> None:
    """Every refusal in the one form."""

    async def ours(request: Request, error: Exception) -> JSONResponse:
        body = error_body(error)
        again_s = getattr(error, "retry_after_s", None)
        headers = None if again_s is None else {"Retry-After": str(math.ceil(again_s))}
        return error_response(status_of(error), body["code"], body["message"], body["detail"], headers)

    for kind in (MastctlError, DriverError, CalibError):
        app.add_exception_handler(kind, ours)

    @app.exception_handler(RequestValidationError)
    async def invalid(request: Request, error: RequestValidationError) -> JSONResponse:
        path = request.url.path.removeprefix(PREFIX)
        words = ("point", "faults", "snapshot", "mast", "track", "simulation/pose", "pose")
        route = next((word for word in words if word in path), "")
        sentences = [sentence(problem, route) for problem in error.errors()[:10]]
        return error_response(422, "bad_request", sentences[0], {"problems": sentences})

    @app.exception_handler(HTTPException)
    async def http(request: Request, error: HTTPException) -> JSONResponse:
        words = {
            404: ("not_found", f"there is nothing at {request.url.path[:120]}; see /openapi.json"),
            405: ("method_not_allowed", f"{request.method} is not possible at {request.url.path[:120]}"),
        }
        code, message = words.get(error.status_code, ("bad_request", str(error.detail)))
        return error_response(error.status_code, code, message, headers=error.headers)

    @app.exception_handler(Exception)
    async def defect(request: Request, error: Exception) -> JSONResponse:
        body = error_body(error)
        return error_response(500, body["code"], body["message"])
