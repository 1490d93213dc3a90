"""What stands before the API: whose page asks, how much it sends, and whether that is JSON at all.

A daemon on the loopback address is within reach of every web page that this machine's browser opens. Two
checks keep such pages out: the Host must be a loopback name (a foreign name that resolves to 127.0.0.1 is
refused), and an unsafe request that a browser says comes from another origin is refused.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from typing import Any, NoReturn
from urllib.parse import urlsplit

from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from mastctl.config import is_loopback

log = logging.getLogger(__name__)

LARGEST_BODY_BYTES = 65536
_UNSAFE = frozenset({"POST", "PUT", "PATCH", "DELETE"})
_HEADERS = [(b"cache-control", b"no-store"), (b"x-content-type-options", b"nosniff")]


class GuardError(Exception):
    """A request that does not get as far as the API."""

    def __init__(self, status: int, code: str, message: str) -> None:
        self.status = status
        self.code = code
        super().__init__(message)


def error_response(
    status: int, code: str, message: str, detail: Any = None, headers: Mapping[str, str] | None = None
) -> JSONResponse:
    """Return an error as the contract has it."""
    body = {"error": {"code": code, "message": message, "detail": detail}}
    return JSONResponse(body, status_code=status, headers=dict(headers or {}))


class Guard:
    """ASGI middleware around the API.

    Parameters
    ----------
    app
        What it guards.
    ignores_body
        Paths that must always work: whatever body comes with them is dropped unread.
    reads_body
        Paths that must always work and read what they can of their body themselves.
    """

    def __init__(
        self,
        app: ASGIApp,
        ignores_body: frozenset[str] = frozenset(),
        reads_body: frozenset[str] = frozenset(),
    ) -> None:
        self._app = app
        self._ignores_body = ignores_body
        self._reads_body = reads_body

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        started = False

        async def send_marked(message: Message) -> None:
            nonlocal started
            if message["type"] == "http.response.start":
                started = True
                message = {**message, "headers": [*message.get("headers", []), *_HEADERS]}
            await send(message)

        try:
            headers = _headers(scope)
            _check_host(headers)
            if scope["method"] in _UNSAFE:
                _check_origin(headers)
                if scope["path"] not in self._reads_body:
                    body = b""
                    if scope["path"] not in self._ignores_body:
                        body = await _body(receive, headers)
                        _check_json(body, headers)
                    receive = _once(body, receive)
            await self._app(scope, receive, send_marked)
        except GuardError as refusal:
            response = error_response(refusal.status, refusal.code, str(refusal))
            await response(scope, receive, send_marked)
        except Exception:  # a defect: the client gets a sentence, the log the rest
            log.exception("%s %s met a defect of the program", scope["method"], scope["path"])
            if not started:
                message = "the service met a defect of its own; its log says more"
                await error_response(500, "internal", message)(scope, receive, send_marked)


def _headers(scope: Scope) -> dict[str, str]:
    return {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}


def _check_host(headers: Mapping[str, str]) -> None:
    """Refuse a Host that is no loopback name."""
    host = headers.get("host", "")
    try:
        name = urlsplit(f"//{host}").hostname or ""
    except ValueError:
        name = ""
    if not is_loopback(name):
        raise GuardError(
            403, "foreign_host", f"Host is '{host[:80]}' where a loopback name such as 127.0.0.1 is expected"
        )


def _check_origin(headers: Mapping[str, str]) -> None:
    """Refuse a request that changes something and comes from another site's page."""
    origin = headers.get("origin")
    if origin is None:
        return
    try:
        netloc = urlsplit(origin).netloc
    except ValueError:
        netloc = ""
    if netloc.lower() != headers.get("host", "").lower():
        raise GuardError(403, "foreign_origin", f"Origin is '{origin[:80]}', which is not this service")


async def _body(receive: Receive, headers: Mapping[str, str]) -> bytes:
    """Read the whole body, which may not be large."""
    told = headers.get("content-length", "0")
    if told.isdecimal() and int(told[:20]) > LARGEST_BODY_BYTES:
        _too_large()
    parts: list[bytes] = []
    size = 0
    while True:
        message = await receive()
        if message["type"] == "http.disconnect":
            raise GuardError(400, "disconnected", "the client left before its request had come whole")
        part = message.get("body", b"")
        size += len(part)
        if size > LARGEST_BODY_BYTES:
            _too_large()
        parts.append(part)
        if not message.get("more_body", False):
            return b"".join(parts)


def _too_large() -> NoReturn:
    raise GuardError(413, "too_large", f"the body is larger than {LARGEST_BODY_BYTES} bytes")


def _check_json(body: bytes, headers: Mapping[str, str]) -> None:
    """Refuse a body that is not JSON as the standard has it: finite numbers, each key once."""
    if not body.strip():
        return
    kind = headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":
        raise GuardError(415, "not_json", f"Content-Type is '{kind[:60]}' where application/json is expected")
    try:
        json.loads(body, parse_constant=_no_constant, object_pairs_hook=_no_duplicates)
    except RecursionError:
        raise GuardError(400, "not_json", "the body is nested too deeply") from None
    except ValueError as error:
        raise GuardError(400, "not_json", f"the body is not JSON: {' '.join(str(error).split())}") from None


def _no_constant(word: str) -> NoReturn:
    raise ValueError(f"{word} where a finite number is expected")


def _no_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"the key '{key[:60]}' is there twice")
        found[key] = value
    return found


def _once(body: bytes, receive: Receive) -> Receive:
    """Give the body that was read already, then whatever comes."""
    given = False

    async def again() -> Message:
        nonlocal given
        if not given:
            given = True
            return {"type": "http.request", "body": body, "more_body": False}
        return await receive()

    return again
