"""A stop passes whatever else was requested before it."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from mastctl.http.guard import EntryRules, Guard
from mastctl.http.waiting import Waiting

CROWD = 40


@pytest.mark.parametrize("stop", ["/api/v1/stop", "/api/v1/estop", "//api/v1/stop/"])
def test_a_stop_passes_what_came_before_it(stop: str) -> None:
    begun: list[str] = []

    async def inside(scope: Any, receive: Any, send: Any) -> None:
        begun.append(scope["path"])

    async def crowd() -> None:
        guard = Guard(inside, EntryRules(), Waiting(), None)
        requests = [("GET", "/api/v1/health/live")] * CROWD + [("POST", stop)]
        async with asyncio.TaskGroup() as group:
            for method, path in requests:
                scope = {
                    "type": "http", "method": method, "path": path, "query_string": b"",
                    "headers": [(b"host", b"127.0.0.1")], "client": ("127.0.0.1", 7), "state": {},
                }  # fmt: skip
                group.create_task(guard(scope, None, None))  # type: ignore[arg-type]

    asyncio.run(crowd())
    assert len(begun) == CROWD + 1
    place = [one.rpartition("stop")[1] for one in begun].index("stop")
    assert place < 3, f"the stop began after {place} other requests"
