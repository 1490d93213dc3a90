"""Routes of the state, of operations and the stop, of the rover's pose and the track."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from functools import partial
from typing import Any, TypeVar

from fastapi import FastAPI
from fastapi.responses import StreamingResponse

from mastctl.errors import Unable
from mastctl.service.service import Service
from mastctl.web import PREFIX
from mastctl.web.models import PointBody, PoseBody, TrackBody
from mastctl.web.waiting import Waiting

T = TypeVar("T")

STOP_ANSWER_S = 3.0  # the devices give a stop 1 s; beyond this it is told that nothing is known
STREAM_POLL_S = 0.05  # how late a change may be told
STREAM_ALIVE_S = 5.0


async def stopped(service: Service, stop: Callable[[], T]) -> T:
    """Run a stop in the threads that are there for it. Raises Unable ``stop_pending``, DriverError."""
    try:
        return await asyncio.wait_for(asyncio.wrap_future(service.stop_threads.submit(stop)), STOP_ANSWER_S)
    except TimeoutError:
        words = f"the stop did not come back within {STOP_ANSWER_S:g} s; the head may still move"
        raise Unable("stop_pending", words) from None


def add_pointing(app: FastAPI, service: Service, waiting: Waiting) -> None:
    """State, operations and the stop."""

    @app.get(f"{PREFIX}/status", summary="What is known at this moment")
    async def status() -> dict[str, Any]:
        return service.state().told(service.head)

    @app.post(f"{PREFIX}/point", status_code=202, summary="Point at a pixel, a position, or joint angles")
    async def point(body: PointBody) -> dict[str, Any]:
        told = body.model_dump(exclude_none=True)
        return {"id": (await waiting.run(lambda: service.point(body.request(), told))).id}

    @app.get(f"{PREFIX}/operations", summary="The newest operations, without their steps")
    async def operations() -> dict[str, Any]:
        return {"operations": [entry.told(steps=False) for entry in service.operations.all()]}

    @app.get(f"{PREFIX}/operations/{{operation_id}}", summary="One operation's record")
    async def operation(operation_id: str) -> dict[str, Any]:
        return service.operations.get(operation_id).told()

    @app.post(f"{PREFIX}/stop", summary="Stop the mast and the running operation, at once")
    async def stop() -> dict[str, Any]:
        return await stopped(service, service.stop_told)


def add_tracking(app: FastAPI, service: Service, waiting: Waiting) -> None:
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
        work = partial(service.start_track, body.target(), {"track": asked})
        return {"id": (await waiting.run(work)).id}

    @app.post(f"{PREFIX}/track/look", status_code=202, summary="Look for the target once more")
    async def look() -> dict[str, Any]:
        return {"id": (await waiting.run(service.look_for_target)).id}

    @app.post(f"{PREFIX}/track/stop", summary="End the track; the head stops if it moves for it")
    async def stop() -> dict[str, Any]:
        await stopped(service, service.stop_track)
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
