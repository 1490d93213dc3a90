"""Checks before the API: the page's origin, the caller, how much is sent, and whether that is JSON.

Every web page that a browser has open can send requests to whatever the browser's machine reaches. A foreign
name in Host means that another site's name resolves to this daemon (DNS rebinding). A foreign Origin or
Sec-Fetch-Site means that the request is of another site's page.

A stop passes nearly all of the checks: only another site's page is refused one. Empty parts of its address (a
slash too many) do not matter; everything else has one address.
"""

from __future__ import annotations

import ipaddress
import json
import logging
import math
import sys
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from typing import Any, NoReturn, Protocol
from urllib.parse import parse_qsl, urlsplit

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from mastctl.config import is_loopback
from mastctl.control.lease import NETWORK, Caller, client_name
from mastctl.errors import BadRequest, MastctlError, NotAllowed, NotLetIn, one_line
from mastctl.http import PREFIX
from mastctl.http.refusals import BadHttp, marked, refusal_response
from mastctl.http.tokens import Access, Token

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
"""Refusals that are recorded of reading too; of requests that change something each one is."""
SCHEME = "bearer "
SCHEMES = ("http", "https")
"""Of a page of the daemon's own; https by a reverse proxy."""
FORWARDED = ("forwarded", "via", "x-real-ip", "x-client-ip", "true-client-ip", "cf-connecting-ip")
"""Headers by which a proxy states that a request came from elsewhere, beside all of ``X-Forwarded-...``."""

_SECRETS = frozenset({"token", "access_token", "authorization", "api_key", "apikey"})


@dataclass
class EntryRules:
    """A daemon's rules for its clients.

    It answers to loopback names and to ``hosts``, in lower case; with ``any_address`` to any IP address too,
    which no name server can point elsewhere. Without ``access`` every client that reaches it may do
    everything, ``via`` this machine's ``loopback`` address under loopback names, or a ``unix`` socket.
    """

    hosts: frozenset[str] = frozenset()
    any_address: bool = False
    access: Access | None = None
    via: str = "loopback"

    def check_host(self, headers: Mapping[str, str]) -> None:
        """Pass a request for one of these names. Raises NotAllowed ``foreign_host``."""
        host = headers.get("host", "")
        name = _url_parts(f"//{host}").hostname or ""
        if is_loopback(name) or name in self.hosts or (self.any_address and _is_address(name)):
            return
        known = ", ".join(sorted(self.hosts)) or "a loopback name such as 127.0.0.1"
        expected = f"{known} is expected (listen.hosts of the configuration)"
        raise NotAllowed("foreign_host", f"Host is '{_shown(host)}' where {expected}")

    def caller(self, scope: Mapping[str, Any], headers: Mapping[str, str]) -> Caller:
        """Return the caller of a request.

        Raises NotLetIn ``no_token``, ``wrong_token``, NotAllowed ``foreign_origin`` for a page's cookie
        without an Origin where something is changed.
        """
        if self.access is None:
            if by := forwarded(headers):
                reason = f"{by.title()} shows that the request came through a proxy"
                remedy = "set listen.hosts, so that clients need one"
                raise NotLetIn("no_token", f"{reason}, and this daemon has no tokens: {remedy}")
            name = client_name(headers.get("mastctl-client"))
            return Caller(name, "admin", self.via, address_of(scope))
        text, by_cookie = shown_token(scope, headers)
        if text is None:
            raise NotLetIn("no_token", "a token is expected: Authorization: Bearer TOKEN, or a cookie")
        token = self.access.token_of(text)
        if by_cookie and (changes(scope) or scope["type"] == "websocket") and "origin" not in headers:
            raise NotAllowed("foreign_origin", "a request with the page's cookie carries its Origin")
        return _named(token, scope, headers)

    def stopper(self, scope: Mapping[str, Any], headers: Mapping[str, str]) -> Caller:
        """Return the caller of a stop or of a health check, which every client may request."""
        if self.access is None:
            return stranger(scope, headers) if forwarded(headers) else self.caller(scope, headers)
        text, _ = shown_token(scope, headers)
        token = None if text is None else self.access.known(text)
        return stranger(scope, headers) if token is None else _named(token, scope, headers)


def check_origin(headers: Mapping[str, str]) -> None:
    """Pass a request that comes from no other site's page. Raises NotAllowed ``foreign_origin``."""
    origin = headers.get("origin")
    if origin is None:
        return
    parts, host = _url_parts(origin), headers.get("host", "").lower()
    if not host or parts.netloc.lower() != host or parts.scheme not in SCHEMES:
        raise NotAllowed("foreign_origin", f"Origin is '{_shown(origin)}', which is not this service")


def check_site(headers: Mapping[str, str], *, page: bool = False) -> None:
    """Pass a request that no browser marks as one of another site's page; to a ``page`` others may link.

    Raises NotAllowed ``foreign_origin``.
    """
    site = headers.get("sec-fetch-site", "none").lower()
    if site in ("same-origin", "none"):
        return
    if page and headers.get("sec-fetch-mode") == "navigate" and headers.get("sec-fetch-dest") == "document":
        return
    message = f"Sec-Fetch-Site is '{_shown(site)}': only the service's own page may request this"
    raise NotAllowed("foreign_origin", message)


def stranger(scope: Mapping[str, Any], headers: Mapping[str, str]) -> Caller:
    """Return the caller of a request without a token, or of one that is refused before that is known."""
    return Caller(client_name(headers.get("mastctl-client")), "view", NETWORK, address_of(scope))


def shown_token(scope: Mapping[str, Any], headers: Mapping[str, str]) -> tuple[str | None, bool]:
    """Return the token of a request, and whether it is the page's cookie; a header goes first."""
    header = headers.get("authorization", "")
    if header[: len(SCHEME)].lower() == SCHEME:
        return header[len(SCHEME) :].strip(), False
    name = cookie_name(scope)
    parts = [part.strip().partition("=") for part in headers.get("cookie", "").split(";")]
    tokens = [value for key, _, value in parts if key == name]
    return (tokens[0], True) if tokens else (None, False)


def cookie_name(scope: Mapping[str, Any]) -> str:
    """Return the page's cookie: one for each port, as browsers share cookies between ports."""
    server = scope.get("server")
    port = server[1] if server else None
    return f"mastctl-{port}" if port else "mastctl"


def address_of(scope: Mapping[str, Any]) -> str:
    """Return the address that a request came from; headers are not trusted for it."""
    client = scope.get("client")
    return str(client[0]) if client else "a socket of this machine"


def from_this_machine(scope: Mapping[str, Any], headers: Mapping[str, str]) -> bool:
    """Return whether a request came from this machine and by no proxy that states otherwise."""
    client, server = scope.get("client"), scope.get("server")
    if forwarded(headers):
        return False
    return not client or is_loopback(str(client[0])) or bool(server and client[0] == server[0])


def forwarded(headers: Mapping[str, str]) -> str:
    """Return the header by which a proxy states that a request came from elsewhere; empty without one.

    Its value is not used: the client may have written it.
    """
    return next((name for name in headers if name in FORWARDED or name.startswith("x-forwarded-")), "")


def changes(scope: Mapping[str, Any]) -> bool:
    """Return whether a request may change something, by its method."""
    return scope["type"] == "http" and scope["method"] not in ("GET", "HEAD", "OPTIONS")


def _named(token: Token, scope: Mapping[str, Any], headers: Mapping[str, str]) -> Caller:
    """The caller with a token: the token's name is proven, the one that the program gives itself is not."""
    given = headers.get("mastctl-client")
    name = f"{token.name}/{client_name(given)}" if given else token.name
    return Caller(name, token.role, "token", address_of(scope), token.sha256)


def _url_parts(text: str) -> Any:
    try:
        return urlsplit(text)
    except ValueError:
        return urlsplit("")


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _shown(text: str) -> str:
    return "".join(sign if sign.isprintable() else "?" for sign in text[:80])


class Records(Protocol):
    """The part of `mastctl.control.entry.CommandEntry` that keeps refusals."""

    def refused(self, caller: Caller, command: str, code: str, message: str) -> None: ...


class Guard:
    """ASGI middleware around the API.

    ``records`` gets the refusals of requests that are no commands yet; ``turn`` is awaited before each
    request that is no stop.
    """

    def __init__(
        self, app: ASGIApp, entrance: EntryRules, turn: Callable[[], Awaitable[None]], records: Records | None
    ) -> None:
        self._app = app
        self._entrance = entrance
        self._turn = turn
        self._records = records

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
            check_origin(headers)
        except MastctlError as refused:
            answer = refusal_response(refused)
            self._record(scope, bytes(answer.body))
            if "websocket.http.response" in scope.get("extensions", {}):
                await answer(scope, receive, send)
            else:
                await send({"type": "websocket.close", "code": 1008, "reason": ""})
            return
        await self._app(scope, receive, send)

    def _let_stop(self, scope: Scope, headers: Mapping[str, str]) -> None:
        """Pass a stop from anything but another site's page."""
        if "origin" in headers:
            self._entrance.check_host(headers)
            check_origin(headers)
        check_site(headers)
        _set_caller(scope, self._entrance.stopper(scope, headers))

    def _let_in(self, scope: Scope, headers: Mapping[str, str]) -> None:
        """Pass a request, or refuse it with the reason."""
        entrance, path = self._entrance, scope["path"]
        entrance.check_host(headers)
        if changes(scope):
            check_origin(headers)
        check_site(headers, page=(path in PAGES or path.startswith(SITE)) and not changes(scope))
        _check_no_secret(scope)
        if path in PAGES or path.startswith(FILES):
            _set_caller(scope, stranger(scope, headers))
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
        caller = state.get("caller") or stranger(scope, _headers(scope))
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


async def whole_body(receive: Receive, headers: Mapping[str, str]) -> bytes:
    """Return the whole body, which may not be large. Raises BadHttp."""
    length = headers.get("content-length", "0")
    size, body, more = int(length[:20]) if length.isdecimal() else 0, b"", True
    while more and size <= LARGEST_BODY_BYTES:
        message = await receive()
        if message["type"] == "http.disconnect":
            raise BadHttp(400, "disconnected", "the client left before its request had come whole")
        body += message.get("body", b"")
        size, more = len(body), message.get("more_body", False)
    if size > LARGEST_BODY_BYTES:
        raise BadHttp(413, "too_large", f"the body is larger than {LARGEST_BODY_BYTES} bytes")
    return body


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
