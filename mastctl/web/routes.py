"""Routes of the state, of operations and the stop, of the rover's pose and the track."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator
from typing import Any

from fastapi import FastAPI, Request
from fastapi.responses import StreamingResponse

from mastctl.commands.deadlines import usual_s
from mastctl.commands.entry import POINT, POSE, STOP, TRACK, TRACK_LOOK, TRACK_STOP
from mastctl.pointing.requests import AnglesTarget
from mastctl.service.service import Service
from mastctl.tracking.status import TrackStatus
from mastctl.web import PREFIX
from mastctl.web.commands import Commands, Headers
from mastctl.web.models import PointBody, PoseBody, TrackBody

STREAM_ALIVE_S = 5.0


def add_pointing(app: FastAPI, service: Service, commands: Commands) -> None:
    """State, operations and the stop."""
    limits = service.config.limits

    @app.get(f"{PREFIX}/status", summary="What is known at this moment")
    async def status() -> dict[str, Any]:
        return service.state().told()

    @app.post(f"{PREFIX}/point", status_code=202, summary="Point at a pixel, a position, or joint angles")
    async def point(body: PointBody, came: Headers) -> dict[str, Any]:
        told, asked = body.model_dump(exclude_none=True), body.request()
        looks = 0 if isinstance(asked.target, AnglesTarget) else asked.pointings

        def act() -> dict[str, Any]:
            return {"id": service.point(asked, told).id}

        return await commands.run(POINT, came, told, act, usual_s(limits, looks))

    @app.get(f"{PREFIX}/operations", summary="The newest operations, without their steps")
    async def operations() -> dict[str, Any]:
        return {"operations": [entry.told(steps=False) for entry in service.operations.all()]}

    @app.get(f"{PREFIX}/operations/{{operation_id}}", summary="One operation's record")
    async def operation(operation_id: str) -> dict[str, Any]:
        return service.operations.get(operation_id).told()

    @app.post(f"{PREFIX}/stop", summary="Stop the mast and the running operation, at once")
    async def stop(request: Request) -> dict[str, Any]:
        return await commands.first(STOP, request, service.stop_told)


def add_tracking(app: FastAPI, service: Service, commands: Commands) -> None:
    """The rover's pose, and the track."""
    told = service.track_told
    allowed_s = usual_s(service.config.limits, 1)

    @app.post(f"{PREFIX}/pose", summary="Say where the rover stands; a track is carried over and looked for")
    async def pose(body: PoseBody, came: Headers) -> dict[str, Any]:
        stands = body.pose(service.clock.now_s())

        def act() -> dict[str, Any]:
            operation = service.take_pose(stands, body.look)
            return {"operation": operation, "track": told()}

        return await commands.run(POSE, came, body.model_dump(exclude_none=True), act, allowed_s)

    @app.get(f"{PREFIX}/track", summary="The track at this moment")
    async def track() -> dict[str, Any]:
        return told()

    @app.post(f"{PREFIX}/track", status_code=202, summary="Follow what a pixel shows, or is at a position")
    async def start(body: TrackBody, came: Headers) -> dict[str, Any]:
        asked = body.model_dump(exclude_none=True)

        def act() -> dict[str, Any]:
            return {"id": service.start_track(body.target(), {"track": asked}).id}

        return await commands.run(TRACK, came, asked, act, allowed_s)

    @app.post(f"{PREFIX}/track/look", status_code=202, summary="Look for the target once more")
    async def look(came: Headers) -> dict[str, Any]:
        return await commands.run(
            TRACK_LOOK, came, {}, lambda: {"id": service.look_for_target().id}, allowed_s
        )

    @app.post(f"{PREFIX}/track/stop", summary="End the track; the head stops if it moves for it")
    async def stop(came: Headers) -> dict[str, Any]:
        def act() -> dict[str, Any]:
            service.stop_track()
            return {}

        await commands.run_beside(TRACK_STOP, came, act)
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
    with service.machine.publisher.subscribe_here("track", "state", known=False) as changes:
        status = service.tracker.status
        yield _event(service, status)
        while service.machine.standing.word != "closing" and not changes.closed:
            news = await changes.wait(STREAM_ALIVE_S)
            if not news:
                yield ": alive\n\n"
            for one in news:
                if one.topic == "track" and one.value.sequence > status.sequence:
                    status = one.value
                    yield _event(service, status)


def _event(service: Service, status: TrackStatus) -> str:
    return f"data: {json.dumps(service.track_told(status), allow_nan=False)}\n\n"
