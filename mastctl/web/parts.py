"""What the routes are given: the parts of the daemon that a request came to.

The routes themselves are made once a process, whatever many daemons it holds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, cast

from fastapi import Depends
from fastapi.requests import HTTPConnection

from mastctl.http.entrance import EntryRules
from mastctl.http.waiting import Streams, Waiting
from mastctl.service.service import Service
from mastctl.web.pictures import CameraFeeds


@dataclass(frozen=True)
class Parts:
    """What serves one daemon's requests.

    Attributes
    ----------
    service
        What the daemon holds.
    waiting
        Runs what may wait.
    streams
        Who listens to events.
    entrance
        What is asked of who comes in.
    feeds
        Pictures of cameras that have viewers.
    """

    service: Service
    waiting: Waiting
    streams: Streams
    entrance: EntryRules
    feeds: CameraFeeds


async def _parts(line: HTTPConnection) -> Parts:
    return cast(Parts, line.scope["state"]["parts"])


Here = Annotated[Parts, Depends(_parts)]
