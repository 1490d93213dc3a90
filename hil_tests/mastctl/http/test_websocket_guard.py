"""The guard before a WebSocket, called as a server calls it: a token in a header or a cookie is needed."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

from mastctl.http.guard import EntryRules, Guard
from mastctl.http.tokens import Access, TokenList
from mastctl.http.waiting import Waiting

NAME = "rover.test"
ORIGIN = {"origin": f"http://{NAME}"}


class Inside:
    """What the guard lets through, without the 15 ms that FastAPI takes to be made."""

    came: Any = None

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        self.came = scope["state"]["caller"]


@pytest.fixture(scope="module")
def access(tmp_path_factory: pytest.TempPathFactory) -> Access:
    return Access(TokenList(tmp_path_factory.mktemp("tokens")))


def asked(access: Access | None, headers: dict[str, str], query: bytes = b"", told: bool = True) -> Any:
    """Who was let in, or the status of the refusal (403: closed before it was accepted)."""
    inside, sent = Inside(), list[Any]()
    told_headers = {"host": NAME, **headers}
    scope = {
        "type": "websocket", "path": "/api/v1/events", "query_string": query, "client": ("10.0.0.1", 7),
        "server": (NAME, 80), "extensions": {"websocket.http.response": {}} if told else {},
        "headers": [(name.encode(), value.encode("utf-8")) for name, value in told_headers.items()],
    }  # fmt: skip

    async def receive() -> Any:
        return {"type": "websocket.connect"}

    async def send(message: Any) -> None:
        sent.append(message)

    guard = Guard(inside, EntryRules(frozenset({NAME}), True, access), Waiting().turn, None)
    asyncio.run(guard(scope, receive, send))
    if inside.came is not None:
        assert not sent
        return inside.came
    return sent[0].get("status", 403)


def bearer(access: Access, role: str = "view") -> dict[str, str]:
    text = (Path(access.folder) / f"{role}.token").read_text().strip()
    return {"authorization": f"Bearer {text}"}


def cookie(access: Access) -> dict[str, str]:
    text = bearer(access)["authorization"].split()[1]
    return {"cookie": f"mastctl-80={text}"}


def test_a_token_and_a_page_with_its_cookie_come_in(access: Access) -> None:
    assert asked(access, bearer(access, "operate")).role == "operate"
    assert asked(access, {**cookie(access), **ORIGIN}).name == "view"
    assert asked(None, {}).role == "admin"


def test_no_other_client_comes_in(access: Access) -> None:
    assert asked(access, {}) == 401
    assert asked(access, ORIGIN) == 401
    assert asked(access, {**bearer(access), "host": "evil.example"}) == 403
    for origin in ("http://evil.example", "null", "", f"http://{NAME}:1"):
        for shown in (bearer(access), cookie(access)):
            assert asked(access, {**shown, "origin": origin}) == 403
        assert asked(None, {"origin": origin}) == 403
    for site in ("cross-site", "same-site"):
        assert asked(access, {**bearer(access), "sec-fetch-site": site}) == 403
