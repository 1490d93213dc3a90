"""Checks before the API: the page's origin, the caller, how much is sent, and whether that is JSON.

A stop passes nearly all of it: only another site's page is refused one. It is not refused for a slash too
many in its address, nor for naming its host in front as a client of a proxy does. Everything else has one
address.
"""

from __future__ import annotations

import asyncio
import json
import logging
import math
import re
import sys
from collections.abc import Mapping
from typing import Any, NoReturn, Protocol
from urllib.parse import parse_qsl

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from mastctl.control.caller import Caller
from mastctl.errors import MastctlError, one_line
from mastctl.http import PREFIX
from mastctl.http.entrance import EntryRules, changes, check_site
from mastctl.http.refusals import GuardError, error_response, marked, told

log = logging.getLogger(__name__)

STOPS = frozenset({f"{PREFIX}/stop", f"{PREFIX}/estop"})
"""What everybody may ask for who reaches the daemon, whatever else the request says."""
TRACK_STOP = f"{PREFIX}/track/stop"

_WRITTEN = "(?:(?i:https?)://[^/ ]*)?" + "/+".join(["", *PREFIX.split("/")[1:], "(stop|estop|track/+stop)/*"])
_ADDRESS = re.compile(_WRITTEN)
STOP_LINE = re.compile(f"POST {_WRITTEN}[ ?]".encode())
"""How a request begins that stops something; everything else is read in turn."""

UNREAD = frozenset({f"{PREFIX}/stop", TRACK_STOP})
"""Where no body is read; an emergency stop reads what it can of its own."""
SESSION = f"{PREFIX}/session"
"""Where a page keeps its token in a cookie; open to each role."""
HEALTH = frozenset({f"{PREFIX}/health/live", f"{PREFIX}/health/ready"})
"""What a monitor asks that has no token."""
PAGES = frozenset({"/", "/docs"})
SITE = "/docs/"
FILES = ("/page/", SITE)
"""Before the name of each file of the page and of the documentation: no data, so no token is required."""
LARGEST_HEADERS_BYTES = 16384
MOST_HEADERS = 100

ATTACKS = frozenset({"wrong_token", "foreign_host", "foreign_origin"})
"""Refusals that are recorded of reading too; of what changes something each one is."""
RECORDED = 100  # refusals of one party in COUNTED_S; then each RARELY-th
RARELY = 1000
COUNTED_S = 60.0
MOST_PARTIES = 1000

_ONCE = frozenset(
    (
        *("host", "origin", "authorization", "cookie", "content-type", "content-length", "transfer-encoding"),
        *("sec-fetch-site", "sec-fetch-mode", "sec-fetch-dest"),
        *("mastctl-client", "mastctl-lease", "idempotency-key", "deadline-s"),
    )
)
_SECRETS = frozenset({"token", "access_token", "authorization", "api_key", "apikey"})


class Records(Protocol):
    """What of `mastctl.control.entry.CommandEntry` keeps refusals."""

    def refused(
        self, caller: Caller, what: str, code: str, message: str, times: int | None = None
    ) -> None: ...


class Guard:
    """ASGI middleware around the API.

    Parameters
    ----------
    app
        What it guards.
    entrance
        What the daemon asks of who comes in.
    records
        Gets what is refused before it is a command; nobody by default.
    """

    def __init__(
        self, app: ASGIApp, entrance: EntryRules | None = None, records: Records | None = None
    ) -> None:
        self._app = app
        self._entrance = entrance or EntryRules()
        self._records = records
        self._minute = -1
        self._refused: dict[tuple[str, str], int] = {}  # of this minute, by token and address

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            await self._http(scope, receive, send)
        elif scope["type"] == "websocket":
            await self._websocket(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    async def _http(self, scope: Scope, receive: Receive, send: Send) -> None:
        scope, started, refuses = stop_named(scope), False, False

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
            headers, twice = _headers(scope)
            if scope["path"] in STOPS and scope["method"] == "POST":
                self._let_stop(scope, headers)
                if scope["path"] in UNREAD:
                    receive = once(b"", receive)
            else:
                self._let_in(scope, headers, twice)
                if changes(scope):
                    body = b""
                    if scope["path"] not in UNREAD:
                        body = await whole_body(receive, headers)
                        scope.setdefault("state", {})["json"] = read_json(body, headers)
                    receive = once(body, receive)
            await self._app(scope, receive, send_marked)
        except (GuardError, MastctlError) as refused:
            if not started:
                await told(refused)(scope, receive, send_marked)
        except Exception:  # a defect: the client gets a sentence, the log the rest
            log.exception("%s %s met a defect of the program", scope["method"], scope["path"])
            if not started:
                message = "the service met a defect of its own; its log says more"
                await error_response(500, "internal", message)(scope, receive, send_marked)

    async def _websocket(self, scope: Scope, receive: Receive, send: Send) -> None:
        """As for HTTP; a browser cannot be kept from asking, so what it says of its page is all there is."""
        try:
            headers, twice = _headers(scope)
            self._let_in(scope, headers, twice)
            self._entrance.names.check_origin(headers)
            if "cookie" in headers and "authorization" not in headers and self._entrance.access is not None:
                _check_origin_said(headers)
        except (GuardError, MastctlError) as refused:
            self._record(scope, bytes(told(refused).body))
            await _refuse_websocket(refused, scope, receive, send)
            return
        await self._app(scope, receive, send)

    def _let_stop(self, scope: Scope, headers: Mapping[str, str]) -> None:
        """Pass a stop from anybody but another site's page."""
        entrance = self._entrance
        if "origin" in headers:
            entrance.names.check_host(headers)
            entrance.names.check_origin(headers)
        check_site(headers)
        _hand_on(scope, entrance.stopper(scope, headers))

    def _let_in(self, scope: Scope, headers: Mapping[str, str], twice: set[str]) -> None:
        """Pass a request, or say why not."""
        entrance, path = self._entrance, scope["path"]
        _check_size(scope)
        _check_shape(headers, twice)
        entrance.names.check_host(headers)
        if changes(scope):
            entrance.names.check_origin(headers)
        check_site(headers, page=(path in PAGES or path.startswith(SITE)) and not changes(scope))
        _check_no_secret(scope)
        if path in PAGES or path.startswith(FILES):
            _hand_on(scope, entrance.stranger(scope, headers))
        elif path in HEALTH and not changes(scope):
            _hand_on(scope, entrance.stopper(scope, headers))
        else:
            caller = entrance.caller(scope, headers)
            _hand_on(scope, caller)
            # The entry asks each command's role. A body, and a jog's heartbeat, are heard before the entry.
            if changes(scope) and path != SESSION and not caller.may("operate"):
                words = f"{caller.name} may {caller.role}; {scope['method']} {path[:80]} needs operate"
                raise GuardError(403, "role", words)

    def _record(self, scope: Scope, body: bytes) -> None:
        """Record a refusal, as it is told, that no record of a command holds."""
        state: dict[str, Any] = scope.get("state", {})
        try:
            error = json.loads(body)["error"]
        except (ValueError, KeyError):  # no refusal of ours
            return
        if self._records is None or state.get("recorded") or not (changes(scope) or error["code"] in ATTACKS):
            return
        caller = state.get("caller") or self._entrance.stranger(scope, _headers(scope)[0])
        minute = int(asyncio.get_running_loop().time() // COUNTED_S)
        if minute != self._minute or len(self._refused) > MOST_PARTIES:
            self._minute, self._refused = minute, {}
        token = caller.name.partition("/")[0] if caller.credential else ""  # one, in all of its sessions
        party = token, caller.address
        times = self._refused[party] = self._refused.get(party, 0) + 1
        if times <= RECORDED or times % RARELY == 0:
            what = one_line(f"{scope.get('method', 'GET')} {scope['path']}", 100)
            self._records.refused(
                caller,
                what,
                error["code"],
                one_line(error["message"], 200),
                times if times > RECORDED else None,
            )


def _headers(scope: Scope) -> tuple[dict[str, str], set[str]]:
    """The headers, those of one name joined, and which names were there more than once."""
    found: dict[str, str] = {}
    twice: set[str] = set()
    for raw_name, raw_value in scope["headers"]:
        name, value = raw_name.decode("latin-1").lower(), raw_value.decode("latin-1")
        if name in found:
            twice.add(name)
            value = f"{found[name]}, {value}"
        found[name] = value
    return found, twice


def _hand_on(scope: Scope, caller: Caller) -> None:
    state: dict[str, Any] = scope.setdefault("state", {})
    state["caller"] = caller


def _check_size(scope: Scope) -> None:
    """Refuse more than anybody needs to say. Raises GuardError ``headers_too_large``."""
    size = sum(len(name) + len(value) for name, value in scope["headers"])
    if size > LARGEST_HEADERS_BYTES or len(scope["headers"]) > MOST_HEADERS:
        words = f"more than {LARGEST_HEADERS_BYTES} bytes or {MOST_HEADERS} lines of headers"
        raise GuardError(431, "headers_too_large", words, {"Connection": "close"})


def _check_shape(headers: Mapping[str, str], twice: set[str]) -> None:
    """Refuse what two programs in a row may read in two ways. Raises GuardError ``ambiguous``."""
    doubled = sorted(twice & _ONCE)
    if doubled:
        raise _misread(f"the header {doubled[0]} is there twice")
    if "transfer-encoding" in headers and "content-length" in headers:
        raise _misread("Transfer-Encoding and Content-Length are both there; one says how long the body is")


def _misread(words: str) -> GuardError:
    return GuardError(400, "ambiguous", words, {"Connection": "close"})


def _check_no_secret(scope: Scope) -> None:
    """Refuse a token in an address: addresses are kept in logs and histories. Raises GuardError."""
    keys = {key.lower() for key, _ in parse_qsl(scope["query_string"].decode("latin-1"), True)}
    if keys & _SECRETS:
        words = "a token goes into the header Authorization, never into an address; take this one back"
        raise GuardError(400, "token_in_address", words)


def _check_origin_said(headers: Mapping[str, str]) -> None:
    if "origin" not in headers:
        raise GuardError(403, "foreign_origin", "a WebSocket with the page's cookie carries its Origin")


async def _refuse_websocket(refused: Exception, scope: Scope, receive: Receive, send: Send) -> None:
    """Say why, where the server can; else only that."""
    if "websocket.http.response" not in scope.get("extensions", {}):
        await send({"type": "websocket.close", "code": 1008, "reason": ""})
        return
    await told(refused)(scope, receive, send)


LARGEST_BODY_BYTES = 65536


async def whole_body(receive: Receive, headers: Mapping[str, str]) -> bytes:
    """Return the whole body, which may not be large. Raises GuardError."""
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


def read_json(body: bytes, headers: Mapping[str, str]) -> Any:
    """Return what a body holds: JSON with finite numbers and each key once; None for nothing.

    Raises
    ------
    GuardError
        ``not_json``; ``bad_request`` for a number that is JSON and larger than any float.
    """
    if not body.strip():
        return None
    kind = headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":
        raise GuardError(415, "not_json", f"Content-Type is '{kind[:60]}' where application/json is expected")
    try:
        return json.loads(
            body, parse_constant=_no_constant, parse_float=_finite, object_pairs_hook=_no_duplicates
        )
    except RecursionError:
        raise GuardError(400, "not_json", "the body is nested too deeply") from None
    except ValueError as error:
        raise GuardError(400, "not_json", f"the body is not JSON: {' '.join(str(error).split())}") from None


def _no_constant(word: str) -> NoReturn:
    raise ValueError(f"{word} where a finite number is expected")


def _finite(word: str) -> float:
    number = float(word)
    if math.isinf(number):
        words = f"the body holds the number {word[:40]} where at most {sys.float_info.max:.1e} is possible"
        raise GuardError(422, "bad_request", words)
    return number


def _no_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"the key '{key[:60]}' is there twice")
        found[key] = value
    return found


def once(body: bytes, receive: Receive) -> Receive:
    """Give the body that was read already, then whatever comes."""
    given = False

    async def again() -> Message:
        nonlocal given
        if not given:
            given = True
            return {"type": "http.request", "body": body, "more_body": False}
        return await receive()

    return again


def stop_named(scope: Scope) -> Scope:
    """Return a request with the one address of the stop that it asks for; any other as it is."""
    written = _ADDRESS.fullmatch(scope["path"]) if scope["method"] == "POST" else None
    if written is None:
        return scope
    name = TRACK_STOP if written[1].startswith("track") else f"{PREFIX}/{written[1]}"
    return {**scope, "path": name}
