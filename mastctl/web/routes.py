"""Routes of the state, of operations and the stop, of the rover's pose and the track."""

from __future__ import annotations

import threading
from typing import Any

from fastapi import FastAPI, Request

from mastctl.as_json import as_json
from mastctl.commands.deadlines import usual_s
from mastctl.commands.entry import POINT, POSE, STOP, TRACK, TRACK_LOOK, TRACK_STOP
from mastctl.errors import BadRequest, NotNow
from mastctl.motion.requests import AnglesTarget
from mastctl.motion.results import PointingError
from mastctl.web import PREFIX
from mastctl.web.commands import Headers
from mastctl.web.limits import stop_before_keep_outs
from mastctl.web.models import PointBody, PoseBody, PreviewBody, TrackBody
from mastctl.web.parts import Here, Parts


def add_pointing(app: FastAPI) -> None:
    """State, operations and the stop."""

    @app.get(f"{PREFIX}/status", summary="What is known at this moment")
    async def status(here: Here) -> dict[str, Any]:
        return here.service.state().told()

    @app.post(f"{PREFIX}/point", status_code=202, summary="Point at a pixel, a position, or joint angles")
    async def point(body: PointBody, came: Headers, here: Here) -> dict[str, Any]:
        service = here.service
        told, asked = body.model_dump(exclude_none=True), body.request()
        looks = 0 if isinstance(asked.target, AnglesTarget) else asked.pointings

        def act() -> dict[str, Any]:
            return {"id": service.steering.point(asked, told).id}

        return await here.commands.run(POINT, came, told, act, usual_s(service.config.limits, looks))

    @app.post(f"{PREFIX}/point/preview", summary="What a pixel shows, before anything moves")
    async def preview(body: PreviewBody, here: Here) -> dict[str, Any]:
        service, asked = here.service, body.request()
        service.check_camera(body.pixel.camera)
        cancelled = threading.Event()
        try:
            seen = await here.waiting.picture(
                body.pixel.camera, lambda: as_json(service.steering.preview(asked, cancelled))
            )
        except PointingError as error:
            kind = NotNow if error.code in ("head_moving", "stopped") else BadRequest
            raise kind(error.code, str(error)) from None
        finally:
            cancelled.set()
        told: dict[str, Any] = seen
        return told

    @app.get(f"{PREFIX}/operations", summary="The newest operations, without their steps")
    async def operations(here: Here) -> dict[str, Any]:
        return {"operations": [entry.told(steps=False) for entry in here.service.operations.all()]}

    @app.get(f"{PREFIX}/operations/{{operation_id}}", summary="One operation's record")
    async def operation(operation_id: str, here: Here) -> dict[str, Any]:
        return here.service.operations.get(operation_id).told()

    @app.post(f"{PREFIX}/stop", summary="Stop the mast and the running operation, at once")
    async def stop(request: Request, here: Here) -> dict[str, Any]:
        return await here.commands.first(STOP, request, here.service.stopping.stop_told)


def add_tracking(app: FastAPI) -> None:
    """The rover's pose, and the track."""

    def allowed_s(here: Parts) -> float:
        return usual_s(here.service.config.limits, 1)

    @app.post(f"{PREFIX}/pose", summary="Say where the rover stands; a track is carried over and looked for")
    async def pose(body: PoseBody, came: Headers, here: Here) -> dict[str, Any]:
        service = here.service
        stands = body.pose(service.clock.now_s())

        def act() -> dict[str, Any]:
            operation = service.steering.take_pose(stands, body.look)
            stop_before_keep_outs(service)  # a sun of the site frame turns with the rover
            return {"operation": operation, "track": service.track_told()}

        return await here.commands.run(POSE, came, body.model_dump(exclude_none=True), act, allowed_s(here))

    @app.get(f"{PREFIX}/track", summary="The track at this moment")
    async def track(here: Here) -> dict[str, Any]:
        return here.service.track_told()

    @app.post(f"{PREFIX}/track", status_code=202, summary="Follow what a pixel shows, or is at a position")
    async def start(body: TrackBody, came: Headers, here: Here) -> dict[str, Any]:
        asked = body.model_dump(exclude_none=True)

        def act() -> dict[str, Any]:
            return {"id": here.service.steering.start_track(body.target(), {"track": asked}).id}

        return await here.commands.run(TRACK, came, asked, act, allowed_s(here))

    @app.post(f"{PREFIX}/track/look", status_code=202, summary="Look for the target once more")
    async def look(came: Headers, here: Here) -> dict[str, Any]:
        return await here.commands.run(
            TRACK_LOOK, came, {}, lambda: {"id": here.service.steering.look().id}, allowed_s(here)
        )

    @app.post(f"{PREFIX}/track/stop", summary="End the track; the head stops if it moves for it")
    async def stop(came: Headers, here: Here) -> dict[str, Any]:
        def act() -> dict[str, Any]:
            here.service.stopping.stop_track()
            return {}

        await here.commands.run_beside(TRACK_STOP, came, act)
        return here.service.track_told()
