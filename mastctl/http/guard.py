"""Checks before the API: the page's origin, the caller, how much is sent, and whether that is JSON.

A stop passes nearly all of them: only another site's page is refused one. Empty parts of its address (a slash
too many) do not matter; everything else has one address.
"""

from __future__ import annotations

import json
import logging
import math
import sys
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, NoReturn, Protocol
from urllib.parse import parse_qsl

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from mastctl.control.lease import Caller
from mastctl.errors import BadRequest, MastctlError, NotAllowed, one_line
from mastctl.http import PREFIX
from mastctl.http.entrance import EntryRules, changes, check_site, shown_token
from mastctl.http.refusals import BadHttp, marked, refusal_response

log = logging.getLogger(__name__)

STOPS = frozenset({f"{PREFIX}/stop", f"{PREFIX}/estop"})
"""Open to every client that reaches the daemon, whatever else the request says."""
TRACK_STOP = f"{PREFIX}/track/stop"
SESSION = f"{PREFIX}/session"
"""Where a page keeps its token in a cookie; open to each role."""
HEALTH = frozenset({f"{PREFIX}/health/live", f"{PREFIX}/health/ready"})
"""Open to monitors, which have no token."""
PAGES = frozenset({"/", "/docs"})
SITE = "/docs/"
FILES = ("/page/", SITE)
"""Before the name of each file of the page and of the documentation: no data, so no token is required."""
LARGEST_BODY_BYTES = 65536
ATTACKS = frozenset({"wrong_token", "foreign_host", "foreign_origin"})
"""Refusals that are recorded of reading too; of what changes something each one is."""

_SECRETS = frozenset({"token", "access_token", "authorization", "api_key", "apikey"})


class Records(Protocol):
    """What of `mastctl.control.entry.CommandEntry` keeps refusals."""

    def refused(self, caller: Caller, command: str, code: str, message: str) -> None: ...


async def _at_once() -> None:
    """Wait for nothing."""


class Guard:
    """ASGI middleware around the API.

    ``records`` gets what is refused before it is a command; ``turn`` is awaited before each request that is
    no stop.
    """

    def __init__(
        self,
        app: ASGIApp,
        entrance: EntryRules | None = None,
        records: Records | None = None,
        turn: Callable[[], Awaitable[None]] = _at_once,
    ) -> None:
        self._app = app
        self._entrance = entrance or EntryRules()
        self._records = records
        self._turn = turn

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            await self._http(scope, receive, send)
        elif scope["type"] == "websocket":
            await self._websocket(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    async def _http(self, scope: Scope, receive: Receive, send: Send) -> None:
        scope, started, refuses = _stop_scope(scope), False, False

        async def send_marked(message: Message) -> None:
            nonlocal started, refuses
            if message["type"] == "http.response.start":
                started, refuses = True, 400 <= message["status"] < 500
                message = {**message, "headers": marked(message.get("headers", []))}
            elif refuses:
                refuses = False
                self._record(scope, message.get("body", b""))
            await send(message)

        try:
            headers = _headers(scope)
            if scope["path"] in STOPS and scope["method"] == "POST":
                self._let_stop(scope, headers)  # its body is not read; an emergency stop takes what it can
            else:
                await self._turn()
                self._let_in(scope, headers)
                if changes(scope) and scope["path"] != TRACK_STOP:
                    body = await whole_body(receive, headers)
                    scope["state"] |= {"body": body, "json": read_json(body, headers)}
            await self._app(scope, receive, send_marked)
        except Exception as error:
            if not isinstance(error, MastctlError):  # a defect: the client gets a sentence, the log the rest
                log.exception("%s %s met a defect of the program", scope["method"], scope["path"])
            if not started:
                await refusal_response(error)(scope, receive, send_marked)

    async def _websocket(self, scope: Scope, receive: Receive, send: Send) -> None:
        """As for HTTP; for a browser's request the headers that state its page are the only evidence."""
        try:
            await self._turn()
            headers = _headers(scope)
            self._let_in(scope, headers)
            self._entrance.names.check_origin(headers)
            by_cookie = self._entrance.access is not None and shown_token(scope, headers)[1]
            if by_cookie and "origin" not in headers:
                message = "a WebSocket with the page's cookie carries its Origin"
                raise NotAllowed("foreign_origin", message)
        except MastctlError as refused:
            self._record(scope, bytes(refusal_response(refused).body))
            await _refuse_websocket(refused, scope, receive, send)
            return
        await self._app(scope, receive, send)

    def _let_stop(self, scope: Scope, headers: Mapping[str, str]) -> None:
        """Pass a stop from anything but another site's page."""
        entrance = self._entrance
        if "origin" in headers:
            entrance.names.check_host(headers)
            entrance.names.check_origin(headers)
        check_site(headers)
        _set_caller(scope, entrance.stopper(scope, headers))

    def _let_in(self, scope: Scope, headers: Mapping[str, str]) -> None:
        """Pass a request, or refuse it with the reason."""
        entrance, path = self._entrance, scope["path"]
        entrance.names.check_host(headers)
        if changes(scope):
            entrance.names.check_origin(headers)
        check_site(headers, page=(path in PAGES or path.startswith(SITE)) and not changes(scope))
        _check_no_secret(scope)
        if path in PAGES or path.startswith(FILES):
            _set_caller(scope, entrance.stranger(scope, headers))
        elif path in HEALTH and not changes(scope):
            _set_caller(scope, entrance.stopper(scope, headers))
        else:
            caller = entrance.caller(scope, headers)
            _set_caller(scope, caller)
            # The entry checks each command's role. A body, and a jog's heartbeat, are read before the entry.
            if changes(scope) and path != SESSION and not caller.may("operate"):
                message = f"{caller.name} may {caller.role}; {scope['method']} {path[:80]} needs operate"
                raise NotAllowed("role", message)

    def _record(self, scope: Scope, body: bytes) -> None:
        """Record a refusal, by its answer's body, that no record of a command has."""
        state: dict[str, Any] = scope.get("state", {})
        try:
            error = json.loads(body)["error"]
        except (ValueError, KeyError):  # no refusal of ours
            return
        if self._records is None or state.get("recorded") or not (changes(scope) or error["code"] in ATTACKS):
            return
        caller = state.get("caller") or self._entrance.stranger(scope, _headers(scope))
        command = one_line(f"{scope.get('method', 'GET')} {scope['path']}", 100)
        self._records.refused(caller, command, error["code"], one_line(error["message"], 200))


def _headers(scope: Scope) -> dict[str, str]:
    """The headers. Several of one name are joined, which makes none of them valid where one is expected."""
    found: dict[str, str] = {}
    for raw_name, raw_value in scope["headers"]:
        name, value = raw_name.decode("latin-1").lower(), raw_value.decode("latin-1")
        found[name] = f"{found[name]}, {value}" if name in found else value
    return found


def _set_caller(scope: Scope, caller: Caller) -> None:
    state: dict[str, Any] = scope.setdefault("state", {})
    state["caller"] = caller


def _check_no_secret(scope: Scope) -> None:
    """Refuse a token in an address: addresses are kept in logs and histories. Raises BadHttp."""
    keys = {key.lower() for key, _ in parse_qsl(scope["query_string"].decode("latin-1"), True)}
    if keys & _SECRETS:
        message = "a token belongs in the header Authorization, never in an address; revoke this one"
        raise BadHttp(400, "token_in_address", message)


async def _refuse_websocket(refused: Exception, scope: Scope, receive: Receive, send: Send) -> None:
    """Give the reason where the server can."""
    if "websocket.http.response" not in scope.get("extensions", {}):
        await send({"type": "websocket.close", "code": 1008, "reason": ""})
        return
    await refusal_response(refused)(scope, receive, send)


async def whole_body(receive: Receive, headers: Mapping[str, str]) -> bytes:
    """Return the whole body, which may not be large. Raises BadHttp."""
    length = headers.get("content-length", "0")
    if length.isdecimal() and int(length[:20]) > LARGEST_BODY_BYTES:
        _too_large()
    parts: list[bytes] = []
    size = 0
    while True:
        message = await receive()
        if message["type"] == "http.disconnect":
            raise BadHttp(400, "disconnected", "the client left before its request had come whole")
        part = message.get("body", b"")
        size += len(part)
        if size > LARGEST_BODY_BYTES:
            _too_large()
        parts.append(part)
        if not message.get("more_body", False):
            return b"".join(parts)


def _too_large() -> NoReturn:
    raise BadHttp(413, "too_large", f"the body is larger than {LARGEST_BODY_BYTES} bytes")


def read_json(body: bytes, headers: Mapping[str, str]) -> Any:
    """Return the content of a body: JSON with finite numbers and each key once; None for nothing.

    Raises BadHttp ``not_json``, BadRequest for a number that is larger than any float.
    """
    if not body.strip():
        return None
    kind = headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":
        raise BadHttp(415, "not_json", f"Content-Type is '{kind[:60]}' where application/json is expected")
    try:
        return json.loads(
            body, parse_constant=_no_constant, parse_float=_finite, object_pairs_hook=_no_duplicates
        )
    except RecursionError:
        raise BadHttp(400, "not_json", "the body is nested too deeply") from None
    except ValueError as error:
        raise BadHttp(400, "not_json", f"the body is not JSON: {' '.join(str(error).split())}") from None


def _no_constant(text: str) -> NoReturn:
    raise ValueError(f"{text} where a finite number is expected")


def _finite(text: str) -> float:
    number = float(text)
    if math.isinf(number):
        message = f"the body has the number {text[:40]} where at most {sys.float_info.max:.1e} is possible"
        raise BadRequest("bad_request", message)
    return number


def _no_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"the key '{key[:60]}' is there twice")
        found[key] = value
    return found


def _stop_scope(scope: Scope) -> Scope:
    """Return a POST with empty parts of its path left out, if it is then the path of a stop."""
    path = "/" + "/".join(part for part in scope["path"].split("/") if part)
    if scope["method"] == "POST" and path in (*STOPS, TRACK_STOP):
        return {**scope, "path": path}
    return scope
