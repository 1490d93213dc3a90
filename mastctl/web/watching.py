"""Routes for who watches a daemon without using it: Prometheus, and what asks whether it is well."""

from __future__ import annotations

from fastapi import FastAPI, Request, Response

from mastctl.answers import CalibrationReport, LiveTold, ReadyTold, SentinelTold
from mastctl.answers.kinds import WELL
from mastctl.errors import Unable
from mastctl.http import PREFIX
from mastctl.http.guard import from_this_machine
from mastctl.watch.metrics import CONTENT_TYPE
from mastctl.watch.sentinel import SENTINEL_FOLDER, findings
from mastctl.web.commands import caller_of
from mastctl.web.described import file_of
from mastctl.web.parts import Here


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
    async def live(request: Request, here: Here) -> LiveTold:
        access = here.entrance.access
        if access is None or not from_this_machine(request.scope, request.headers):
            return {"live": True}
        return {"live": True, "token_folder": access.folder}

    @app.get(
        f"{PREFIX}/health/ready",
        summary="Whether commands are carried out: 200 if they are, else 503 and why not",
    )
    async def ready(request: Request, here: Here) -> ReadyTold:
        now = here.service.machine.standing
        reason = "" if caller_of(request).stranger else now.reason  # it may name a person
        if now.state not in WELL:
            raise Unable("not_ready", f"{now.state}: {reason}" if reason else now.state)
        return {"ready": True, "state": now.state, "reason": reason}

    @app.get(
        f"{PREFIX}/calibration/health",
        summary="Whether the mast file still holds, with the figures of the last days' residuals",
    )
    async def calibration(here: Here) -> CalibrationReport:
        service = here.service
        health = service.health
        return {
            **health.verdict,
            **service.mast_verdict(),
            "write_error": health.write_error,
            "newest": health.newest(),
            "sentinel": service.sentinel.summary(),
        }

    @app.get(f"{PREFIX}/sentinel", summary="The findings of the drift sentinel, and the age of its last look")
    async def sentinel(here: Here) -> SentinelTold:
        service = here.service
        folder = service.folder.path / SENTINEL_FOLDER
        return await here.waiting.run(lambda: findings(folder, service.stored.digest))
