"""What the routes are given: the parts of the daemon that a request came to.

The routes themselves are made once a process, whatever many daemons it holds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, cast

from fastapi import Depends
from fastapi.requests import HTTPConnection

from mastctl.http.guard import EntryRules
from mastctl.http.waiting import Streams, Waiting
from mastctl.service.service import Service
from mastctl.web.pictures import CameraFeeds


@dataclass(frozen=True)
class Parts:
    """What serves one daemon's requests: what runs work that may wait, the listeners of events, the rules for
    clients, and the pictures of cameras that have viewers.
    """

    service: Service
    waiting: Waiting
    streams: Streams
    entrance: EntryRules
    feeds: CameraFeeds


async def _parts(line: HTTPConnection) -> Parts:
    return cast(Parts, line.scope["state"]["parts"])


Here = Annotated[Parts, Depends(_parts)]
