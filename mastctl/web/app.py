"""The HTTP interface (contract section 4): JSON under /api/v1, described by /openapi.json.

The event loop only reads snapshots. Whatever takes a lock, a file or a device runs in worker threads
(`mastctl.web.waiting`); ``POST /stop`` has threads of its own, so that it never waits behind them.
Every refusal is ``{"error": {"code", "message", "detail"}}``.
"""

from __future__ import annotations

from importlib.metadata import version

from fastapi import FastAPI
from starlette.types import ASGIApp

from mastctl.service.service import Service
from mastctl.web.answers import ErrorBody
from mastctl.web.bench import add_bench
from mastctl.web.commands import Commands
from mastctl.web.described import describe
from mastctl.web.entrance import Entrance
from mastctl.web.estop import add_estop
from mastctl.web.events import Streams, add_events
from mastctl.web.guard import Guard
from mastctl.web.images import add_images
from mastctl.web.lease import add_lease
from mastctl.web.limits import add_limits
from mastctl.web.page import add_page
from mastctl.web.pictures import add_pictures
from mastctl.web.places import add_places
from mastctl.web.recordings import add_recordings
from mastctl.web.refusals import add_errors
from mastctl.web.reload import add_reload
from mastctl.web.routes import add_pointing, add_tracking
from mastctl.web.sessions import add_sessions
from mastctl.web.simulation import add_simulation
from mastctl.web.waiting import Waiting
from mastctl.web.watching import add_watching


def create_app(
    service: Service,
    waiting: Waiting | None = None,
    entrance: Entrance | None = None,
    streams: Streams | None = None,
) -> ASGIApp:
    """Return the ASGI application that serves one service.

    Parameters
    ----------
    waiting
        Tells its requests when the daemon ends.
    entrance
        What it asks of who comes in; nothing but a loopback name by default.
    streams
        Ends who listens to events when the daemon ends.
    """
    waiting = waiting or Waiting(service.clock)
    entrance = entrance or Entrance()
    app = FastAPI(
        title="mastctl",
        version=version("mastctl"),
        description="A rover mast: state, pointing with a measured residual, pictures with their facts.",
        responses={status: {"model": ErrorBody, "description": "Refused"} for status in ("4XX", "5XX", 422)},
        docs_url=None,
        redoc_url=None,
    )
    add_errors(app)
    add_sessions(app, entrance)
    commands = Commands(service, waiting)
    add_pointing(app, service, waiting, commands)
    add_estop(app, service, waiting, commands)
    add_lease(app, service, commands)
    add_tracking(app, service, commands)
    add_limits(app, service, commands)
    add_pictures(app, service, waiting, commands)
    add_places(app, service, waiting, commands)
    add_recordings(app, service, waiting, commands)
    add_bench(app, service, waiting, commands)
    add_reload(app, service, commands)
    add_simulation(app, service, waiting, commands)
    add_watching(app, service, waiting)
    streams = streams or Streams(service.machine.publisher)
    add_events(app, service, streams)
    add_images(app, service, streams)
    add_page(app, service, waiting)
    describe(app)
    return Guard(app, entrance)
