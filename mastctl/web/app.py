"""The HTTP interface (contract section 4): JSON under /api/v1, described by /openapi.json.

The event loop only reads snapshots. Whatever takes a lock, a file or a device runs in worker threads
(`mastctl.web.waiting`); ``POST /stop`` has threads of its own, so that it never waits behind them.
Every refusal is ``{"error": {"code", "message", "detail"}}``.
"""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import AsyncIterator, Callable, Mapping
from functools import partial
from importlib.metadata import version
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import cv2
import numpy as np
from fastapi import FastAPI, Query, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response, StreamingResponse
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp

from calib.errors import CalibError
from drivers.errors import BadFrame, BadOptions, BadReply, DriverError
from drivers.faults import Fault as SetFault
from drivers.faults import FaultPanel
from mastctl.as_json import as_json
from mastctl.devices.frames import StampedFrame
from mastctl.devices.limits import OutsideLimits
from mastctl.errors import MastctlError
from mastctl.operations import error_body
from mastctl.service.mast_in_use import MastInUse
from mastctl.service.service import Service
from mastctl.tracking.pose import RoverPose
from mastctl.web.guard import Guard, error_response
from mastctl.web.models import (
    ErrorBody,
    FaultBody,
    FaultsQuery,
    MastBody,
    PointBody,
    PoseBody,
    SnapshotQuery,
    StandBody,
    TrackBody,
    sentence,
)
from mastctl.web.waiting import Waiting

if TYPE_CHECKING:
    from drivers.sim.rover import SimulatedRover

T = TypeVar("T")

PREFIX = "/api/v1"
STOP_ANSWER_S = 3.0  # the devices give a stop 1 s; beyond this it is told that nothing is known
JPEG_QUALITY = 90
STREAM_POLL_S = 0.05  # how late a change may be told
STREAM_ALIVE_S = 5.0
PNG_COMPRESSION = 1  # a noisy picture gains 10 % from more, and takes five times as long

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


class NotSimulated(MastctlError):
    """Faults and the true pose are a simulated rover's only."""

    code = "not_simulated"


class StopUnconfirmed(MastctlError):
    """A stop was sent, and nothing came back."""

    code = "stop_pending"


def create_app(service: Service, waiting: Waiting | None = None) -> ASGIApp:
    """Return the ASGI application that serves one service; ``waiting`` tells its requests when it ends."""
    waiting = waiting or Waiting()
    app = FastAPI(
        title="mastctl",
        version=version("mastctl"),
        description="A rover mast: state, pointing with a measured residual, pictures with their facts.",
        responses={status: {"model": ErrorBody, "description": "Refused"} for status in ("4XX", "5XX", 422)},
        docs_url=None,
        redoc_url=None,
    )
    _add_errors(app)
    _add_pointing(app, service, waiting)
    _add_tracking(app, service, waiting)
    _add_pictures(app, service, waiting)
    _add_simulation(app, service, waiting)
    return Guard(app, ignores_body=frozenset({f"{PREFIX}/stop", f"{PREFIX}/track/stop"}))


async def _stopped(service: Service, stop: Callable[[], T]) -> T:
    """Run a stop in the threads that are there for it. Raises StopsHang, StopUnconfirmed, DriverError."""
    try:
        return await asyncio.wait_for(asyncio.wrap_future(service.stop_threads.submit(stop)), STOP_ANSWER_S)
    except TimeoutError:
        raise StopUnconfirmed(
            f"the stop did not come back within {STOP_ANSWER_S:g} s; the head may still move"
        ) from None


def _add_pointing(app: FastAPI, service: Service, waiting: Waiting) -> None:
    """State, operations and the stop."""

    @app.get(f"{PREFIX}/status", summary="What is known at this moment")
    async def status() -> dict[str, Any]:
        return service.state().told(service.head)

    @app.post(f"{PREFIX}/point", status_code=202, summary="Point at a pixel, a position, or joint angles")
    async def point(body: PointBody) -> dict[str, Any]:
        told = body.model_dump(exclude_none=True)
        digest = None if body.pixel is None else body.pixel.mast_digest
        return {"id": (await waiting.run(lambda: service.point(body.request(), told, digest))).id}

    @app.get(f"{PREFIX}/operations", summary="The newest operations, without their steps")
    async def operations() -> dict[str, Any]:
        return {"operations": [entry.told(steps=False) for entry in service.operations.all()]}

    @app.get(f"{PREFIX}/operations/{{operation_id}}", summary="One operation's record")
    async def operation(operation_id: str) -> dict[str, Any]:
        return service.operations.get(operation_id).told()

    @app.post(f"{PREFIX}/stop", summary="Stop the mast and the running operation, at once")
    async def stop() -> dict[str, Any]:
        return {"stopped": True, "operation": await _stopped(service, service.stop)}


def _add_tracking(app: FastAPI, service: Service, waiting: Waiting) -> None:
    """The rover's pose, and the track."""
    told = service.track_told

    @app.post(f"{PREFIX}/pose", summary="Say where the rover stands; a track is carried over and looked for")
    async def pose(body: PoseBody) -> dict[str, Any]:
        came = body.pose(service.clock.now_s())
        operation = await waiting.run(lambda: service.take_pose(came, body.look))
        return {"operation": operation, "track": told()}

    @app.get(f"{PREFIX}/track", summary="The track at this moment")
    async def track() -> dict[str, Any]:
        return told()

    @app.post(f"{PREFIX}/track", status_code=202, summary="Follow what a pixel shows, or is at a position")
    async def start(body: TrackBody) -> dict[str, Any]:
        asked = body.model_dump(exclude_none=True)
        digest = None if body.pixel is None else body.pixel.mast_digest
        work = partial(service.start_track, body.target(), {"track": asked}, digest)
        return {"id": (await waiting.run(work)).id}

    @app.post(f"{PREFIX}/track/look", status_code=202, summary="Look for the target once more")
    async def look() -> dict[str, Any]:
        return {"id": (await waiting.run(service.look_for_target)).id}

    @app.post(f"{PREFIX}/track/stop", summary="End the track; the head stops if it moves for it")
    async def stop() -> dict[str, Any]:
        await _stopped(service, service.stop_track)
        return told()

    @app.get(
        f"{PREFIX}/track/stream",
        summary="The track as server-sent events: now, and at each change",
        response_class=StreamingResponse,
        responses={200: {"content": {"text/event-stream": {}}}},
    )
    async def stream() -> StreamingResponse:
        return StreamingResponse(_track_events(service), media_type="text/event-stream")


async def _track_events(service: Service) -> AsyncIterator[str]:
    """Each change of the track as an event, and a comment now and then to show that somebody is there."""
    told, quiet_s = -1, 0.0
    while not service.operations.closed:
        status = service.tracker.status
        if status.sequence != told:
            told, quiet_s = status.sequence, 0.0
            yield f"data: {json.dumps(service.track_told(status), allow_nan=False)}\n\n"
        elif quiet_s >= STREAM_ALIVE_S:
            quiet_s = 0.0
            yield ": alive\n\n"
        await asyncio.sleep(STREAM_POLL_S)
        quiet_s += STREAM_POLL_S


def _add_pictures(app: FastAPI, service: Service, waiting: Waiting) -> None:
    """Frames with their facts, and the mast file they are to be read by."""

    @app.get(
        f"{PREFIX}/snapshot/{{camera}}",
        summary="A picture; its facts are in X-Mastctl headers",
        response_class=Response,
        responses={200: {"content": {"image/png": {}, "image/jpeg": {}}}},
    )
    async def snapshot(camera: str, query: Annotated[SnapshotQuery, Query()]) -> Response:
        service.check_camera(camera)
        frame_id = query.frame_id
        if frame_id is not None:
            return await waiting.run(lambda: picture(service.kept_frame(camera, frame_id), query.format))
        return await waiting.picture(
            camera, lambda: picture(service.snapshot(camera, query.fresh), query.format)
        )

    def picture(frame: StampedFrame, kind: str) -> Response:
        return Response(encoded(frame.image, kind), media_type=f"image/{kind}", headers=frame_headers(frame))

    @app.get(f"{PREFIX}/mast", summary="The mast file in use, byte for byte", response_class=Response)
    async def mast() -> Response:
        in_use = service.mast
        return Response(
            in_use.data,
            media_type="application/yaml",
            headers={"X-Mastctl-Mast-Digest": in_use.stored.digest},
        )

    @app.post(f"{PREFIX}/mast", summary="Use another mast file, or the former one, from now on")
    async def load_mast(body: MastBody) -> dict[str, Any]:
        name = body.file
        work = service.former_mast if name is None else partial(service.load_mast, name)
        return told(await waiting.run(work))

    @app.post(f"{PREFIX}/mast/back", summary="Go back to the former mast file")
    async def back() -> dict[str, Any]:
        return told(await waiting.run(service.former_mast))

    def told(mast: MastInUse) -> dict[str, Any]:
        former = service.former
        return {"mast": mast.told(), "former_mast": None if former is None else former.told()}


def _add_simulation(app: FastAPI, service: Service, waiting: Waiting) -> None:
    """The fault switches of a simulated rover, and where it truly stands."""

    def simulated(what: str) -> SimulatedRover:
        if service.hardware.simulation is None:
            kind = service.hardware.kind
            raise NotSimulated(
                f"{what} are for this program's own simulated rover only; the hardware is {kind}"
            )
        return service.hardware.simulation

    def panel() -> FaultPanel:
        return simulated("faults").faults

    def stands() -> dict[str, Any]:
        pose = RoverPose(simulated("true poses").site_from_rover).told(0.0)
        return {"position_m": pose["position_m"], "quaternion": pose["quaternion"]}

    @app.get(f"{PREFIX}/simulation/pose", summary="Where the simulated rover truly stands")
    async def true_pose() -> dict[str, Any]:
        return await waiting.run(stands)

    @app.post(f"{PREFIX}/simulation/pose", summary="Put the simulated rover somewhere on its ground")
    async def stand(body: StandBody) -> dict[str, Any]:
        def put() -> dict[str, Any]:
            rover = simulated("true poses")
            rover.stand(body.x_m, body.y_m, body.heading_rad, body.pitch_rad, body.roll_rad)
            return stands()

        return await waiting.run(put)

    def told() -> dict[str, Any]:
        return {"faults": [_fault_told(fault) for fault in panel().active()]}

    @app.get(f"{PREFIX}/simulation/faults", summary="The faults that are switched on")
    async def faults() -> dict[str, Any]:
        return await waiting.run(told)

    @app.post(f"{PREFIX}/simulation/faults", summary="Switch a fault on")
    async def set_fault(body: FaultBody) -> dict[str, Any]:
        await waiting.run(lambda: panel().set(body.device, body.word, **body.parameters))
        return await waiting.run(told)

    @app.delete(f"{PREFIX}/simulation/faults", summary="Switch the faults of one device, or all, off")
    async def clear_faults(query: Annotated[FaultsQuery, Query()]) -> dict[str, Any]:
        await waiting.run(lambda: panel().clear(query.device))
        return await waiting.run(told)


def encoded(image: np.ndarray, kind: str) -> bytes:
    """Return a picture as PNG (``png``, lossless) or JPEG (``jpeg``)."""
    options = (
        [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION]
        if kind == "png"
        else [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    )
    done, data = cv2.imencode(f".{kind}", image, options)
    if not done:
        raise MastctlError(f"the picture cannot be written as {kind}")
    return bytes(data)


def frame_headers(frame: StampedFrame) -> dict[str, str]:
    """Return a frame's facts as headers; numbers in shortest round-trip form."""
    return {
        "X-Mastctl-Frame-Id": frame.frame_id,
        "X-Mastctl-Camera": frame.camera,
        "X-Mastctl-Sequence": str(frame.sequence),
        "X-Mastctl-Mid-Exposure-S": repr(frame.mid_exposure_s),
        "X-Mastctl-Exposure-S": repr(frame.exposure_s),
        "X-Mastctl-Pan-Rad": repr(frame.pan_rad),
        "X-Mastctl-Tilt-Rad": repr(frame.tilt_rad),
        "X-Mastctl-Moving": "true" if frame.moving else "false",
        "X-Mastctl-Mast-Digest": frame.mast_digest,
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


def _fault_told(fault: SetFault) -> dict[str, Any]:
    """A set fault as JSON; one without an end has ``end_s`` null."""
    finite = {name: value for name, value in fault.parameters.items() if math.isfinite(value)}
    told = {"device": fault.device, "word": fault.word, "parameters": finite}
    return {**told, "begin_s": fault.begin_s, "end_s": as_json(fault.end_s)}


def _add_errors(app: FastAPI) -> None:
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
