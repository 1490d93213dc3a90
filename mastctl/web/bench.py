"""Routes of guided bench calibrations, and of reports."""

from __future__ import annotations

import hashlib
from typing import Annotated, Any

from fastapi import FastAPI, Path, Response

from mastctl.commands.entry import BENCH, BENCH_FORGET, BENCH_LEAVE, BENCH_STANDS
from mastctl.guided.runs import NAME
from mastctl.web import PREFIX
from mastctl.web.commands import Headers
from mastctl.web.models import BenchBody
from mastctl.web.parts import Here

REPORT = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)
"""The Content-Security-Policy of a report: its own styles and drawings, no script, an origin of nobody's."""
RunName = Annotated[
    str, Path(pattern=f"^{NAME.pattern}$", description="a run's name, such as 20261126-093000,")
]
ReportName = Annotated[
    str,
    Path(
        pattern="^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$",
        description="1 to 100 letters a to z, digits, '.', '_' and '-', the first a letter or digit,",
    ),
]


def add_bench(app: FastAPI) -> None:
    """A bench calibration begun, answered, ended; reports."""

    @app.get(f"{PREFIX}/bench", summary="The bench calibration at work, and those that are kept")
    async def bench(here: Here) -> dict[str, Any]:
        return await here.waiting.run(here.service.guide.told)

    @app.post(f"{PREFIX}/bench", status_code=202, summary="Begin a bench calibration, or go on with one")
    async def begin(body: BenchBody, came: Headers, here: Here) -> dict[str, Any]:
        wanted, who, last_stop = body.wanted(), came.caller.name, here.service.leases.last_stop

        def act() -> dict[str, Any]:
            return {"run": here.service.guide.start(wanted, who, last_stop).told()}

        asked = body.model_dump(exclude_none=True)
        if body.board_file is not None:
            digest = hashlib.sha256(body.board_file.encode("utf-8", "surrogatepass")).hexdigest()
            asked["board_file"] = f"{len(body.board_file)} signs, SHA-256 {digest[:16]}"
        return await here.commands.run(BENCH, came, asked, act)

    @app.post(f"{PREFIX}/bench/stands", summary="Say that the board stands where it was asked for")
    async def stands(came: Headers, here: Here) -> dict[str, Any]:
        guide = here.service.guide
        return await here.commands.run(BENCH_STANDS, came, {}, lambda: {"run": guide.stands().told()})

    @app.post(f"{PREFIX}/bench/leave", summary="End the bench calibration; it can go on later")
    async def leave(came: Headers, here: Here) -> dict[str, Any]:
        guide, who = here.service.guide, came.caller.name
        return await here.commands.run_beside(BENCH_LEAVE, came, lambda: {"run": guide.leave(who).told()})

    @app.delete(
        f"{PREFIX}/bench/runs/{{name}}",
        summary="Remove a bench calibration that is over, pictures and report",
    )
    async def forget(name: RunName, came: Headers, here: Here) -> dict[str, Any]:
        guide = here.service.guide
        return await here.commands.run(BENCH_FORGET, came, {"name": name}, lambda: guide.forget(name))

    @app.get(f"{PREFIX}/reports", summary="The reports that can be read")
    async def listed(here: Here) -> dict[str, Any]:
        reports = here.service.reports
        found = await here.waiting.run(reports.all)
        return {"reports": [one.told() for one in found], "folder": str(reports.folder)}

    @app.get(f"{PREFIX}/reports/{{name}}", summary="A report", response_class=Response)
    async def report(name: ReportName, here: Here) -> Response:
        page = await here.waiting.run(lambda: here.service.reports.page(name))
        headers = {"Content-Security-Policy": REPORT, "Cross-Origin-Opener-Policy": "same-origin"}
        return Response(page, media_type="text/html; charset=utf-8", headers=headers)
