"""Checks before the API: the page's origin, the caller, and how much is sent.

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
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from mastctl.config import is_loopback
from mastctl.control.entry import CommandEntry
from mastctl.control.lease import NETWORK, Caller, client_name
from mastctl.errors import MastctlError, NotAllowed, NotLetIn, one_line
from mastctl.http import PREFIX
from mastctl.http.refusals import NO_PAGE, PAGE, SITE, marked, refusal_response
from mastctl.http.tokens import Access
from mastctl.http.waiting import Waiting

log = logging.getLogger(__name__)

STOPS = frozenset({f"{PREFIX}/stop", f"{PREFIX}/estop"})
"""Open to every client that reaches the daemon, whatever else the request says."""
TRACK_STOP = f"{PREFIX}/track/stop"
SESSION = f"{PREFIX}/session"
"""Where a page keeps its token in a cookie; open to each role."""
HEALTH = frozenset({f"{PREFIX}/health/live", f"{PREFIX}/health/ready"})
"""Open to monitors, which have no token."""
PAGE_FILES, SITE_FILES = "/page/", "/docs/"
"""Before the name of each file of the page and of the documentation: no data, so no token is required."""
LARGEST_BODY_BYTES = 65536
ATTACKS = frozenset({"wrong_token", "foreign_host", "foreign_origin"})
"""Refusals that are recorded of reading too; of requests that change something each one is."""
SCHEME = "bearer "
FORWARDED = ("forwarded", "via", "x-real-ip", "x-client-ip", "true-client-ip", "cf-connecting-ip")
"""Headers by which a proxy states that a request came from elsewhere, beside all of ``X-Forwarded-...``."""


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

    def check_host(self, line: HTTPConnection) -> None:
        """Pass a request for one of these names. Raises NotAllowed ``foreign_host``."""
        host = line.headers.get("host", "")
        name = _url_parts(f"//{host}").hostname or ""
        if is_loopback(name) or name in self.hosts or (self.any_address and _is_address(name)):
            return
        known = ", ".join(sorted(self.hosts)) or "a loopback name such as 127.0.0.1"
        expected = f"{known} is expected (listen.hosts of the configuration)"
        raise NotAllowed("foreign_host", f"Host is '{one_line(host, 80)}' where {expected}")

    def caller(self, line: HTTPConnection) -> Caller:
        """Return the caller of a request. Raises NotLetIn ``no_token``, ``wrong_token``."""
        given = line.headers.get("mastctl-client")
        if self.access is None:
            if by := forwarded(line):
                reason = f"{by.title()} shows that the request came through a proxy"
                remedy = "set listen.hosts, so that clients need one"
                raise NotLetIn("no_token", f"{reason}, and this daemon has no tokens: {remedy}")
            return Caller(client_name(given), "admin", self.via, address_of(line))
        text = shown_token(line)
        if text is None:
            raise NotLetIn("no_token", "a token is expected: Authorization: Bearer TOKEN, or a cookie")
        token = self.access.token_of(text)
        # The token's name is proven; the one that the program gives itself is not.
        name = f"{token.name}/{client_name(given)}" if given else token.name
        return Caller(name, token.role, "token", address_of(line), token.sha256)

    def any_caller(self, line: HTTPConnection) -> Caller:
        """Return the caller of a stop or of a health check, which every client may request."""
        try:
            return self.caller(line)
        except NotLetIn:
            return stranger(line)


def check_page(line: HTTPConnection) -> None:
    """Pass a request that no other site's page sent; other sites may link to the pages.

    Raises NotAllowed ``foreign_origin``.
    """
    origin, site = line.headers.get("origin"), line.headers.get("sec-fetch-site", "none").lower()
    if origin is not None:
        parts, host = _url_parts(origin), line.headers.get("host", "").lower()
        # A reverse proxy may have made http of https.
        if not host or parts.netloc.lower() != host or parts.scheme not in ("http", "https"):
            shown = one_line(origin, 80)
            raise NotAllowed("foreign_origin", f"Origin is '{shown}', which is not this service")
    linked = line.headers.get("sec-fetch-mode") == "navigate" and not changes(line)
    if site not in ("same-origin", "none") and not (linked and _policy_of_page(line.scope["path"])):
        message = f"Sec-Fetch-Site is '{one_line(site, 80)}': only the service's own page may request this"
        raise NotAllowed("foreign_origin", message)


def stranger(line: HTTPConnection) -> Caller:
    """Return the caller of a request without a token, or of one that is refused before that is known."""
    return Caller(client_name(line.headers.get("mastctl-client")), "view", NETWORK, address_of(line))


def shown_token(line: HTTPConnection) -> str | None:
    """Return the token of a request: a header's, else that of the page's cookie."""
    header = line.headers.get("authorization", "")
    if header[: len(SCHEME)].lower() == SCHEME:
        return header[len(SCHEME) :].strip()
    return line.cookies.get(cookie_name(line))


def cookie_name(line: HTTPConnection) -> str:
    """Return the page's cookie: one for each port, as browsers share cookies between ports."""
    server = line.scope.get("server")
    port = server[1] if server else None
    return f"mastctl-{port}" if port else "mastctl"


def address_of(line: HTTPConnection) -> str:
    """Return the address that a request came from; headers are not trusted for it."""
    return line.client.host if line.client else "a socket of this machine"


def from_this_machine(line: HTTPConnection) -> bool:
    """Return whether a request came from this machine and by no proxy that states otherwise."""
    client = line.client.host if line.client else "localhost"
    here, _ = line.scope.get("server") or ("", None)
    return not forwarded(line) and (is_loopback(client) or client == here)


def forwarded(line: HTTPConnection) -> str:
    """Return the header by which a proxy states that a request came from elsewhere; empty without one.

    Its value is not used: the client may have written it.
    """
    names = line.headers.keys()
    return next((name for name in names if name in FORWARDED or name.startswith("x-forwarded-")), "")


def changes(line: HTTPConnection) -> bool:
    """Return whether a request may change something, by its method."""
    return line.scope["type"] == "http" and line.scope["method"] not in ("GET", "HEAD", "OPTIONS")


def _policy_of_page(path: str) -> str:
    """The Content-Security-Policy of the page, of the documentation, or of their files; empty of the rest."""
    if path == "/" or path.startswith(PAGE_FILES):
        return PAGE
    return SITE if f"{path}/".startswith(SITE_FILES) else ""


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


class Guard:
    """ASGI middleware around the API, for requests and for WebSockets.

    ``records`` gets the refusals of requests that are no commands yet; what is no stop waits for its turn.
    """

    def __init__(
        self,
        app: ASGIApp,
        entrance: EntryRules,
        waiting: Waiting,
        records: CommandEntry | None,
    ) -> None:
        self._app = app
        self._entrance = entrance
        self._waiting = waiting
        self._records = records

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        scope, started, refuses = _usual(scope), False, False
        line, policy = HTTPConnection(scope), _policy_of_page(scope["path"])
        keep = "no-cache" if policy else "no-store"  # a browser keeps a page, and checks each time

        async def send_marked(message: Message) -> None:
            nonlocal started, refuses
            if message["type"].endswith("response.start"):  # of a WebSocket that is refused, too
                started, refuses = True, 400 <= message["status"] < 500
                message = {**message, "headers": marked(message.get("headers", []), policy or NO_PAGE, keep)}
            elif refuses:
                refuses = False
                self._record(line, message.get("body", b""))
            await send(message)

        try:
            if scope["path"] in STOPS and scope.get("method") == "POST":
                if "origin" in line.headers:
                    self._entrance.check_host(line)
                check_page(line)
                _set_caller(line, self._entrance.any_caller(line))
            else:
                await self._waiting.turn()
                self._let_in(line)
            await self._app(scope, bounded(receive), send_marked)
        except Exception as error:
            if not isinstance(error, MastctlError):  # a defect: the client gets a sentence, the log the rest
                log.exception("%s met a defect of the program", scope["path"])
            if not started:
                await refusal_response(error)(scope, receive, send_marked)

    def _let_in(self, line: HTTPConnection) -> None:
        """Pass a request and note its caller, or refuse it with the reason."""
        entrance, path = self._entrance, line.scope["path"]
        entrance.check_host(line)
        check_page(line)
        if _policy_of_page(path):
            _set_caller(line, stranger(line))
        elif path in HEALTH and not changes(line):
            _set_caller(line, entrance.any_caller(line))
        else:
            caller = entrance.caller(line)
            _set_caller(line, caller)
            # The entry checks each command's role. A body, and a jog's heartbeat, are read before the entry.
            if changes(line) and path != SESSION:
                caller.check_may("operate", f"{line.scope['method']} {path[:80]}")

    def _record(self, line: HTTPConnection, body: bytes) -> None:
        """Record a refusal, by its answer's body, that no record of a command has."""
        state: dict[str, Any] = line.scope.get("state", {})
        try:
            error = json.loads(body)["error"]
        except (ValueError, KeyError):  # no refusal of ours
            return
        if self._records is None or state.get("recorded") or not (changes(line) or error["code"] in ATTACKS):
            return
        command = one_line(f"{line.scope.get('method', 'GET')} {line.scope['path']}", 100)
        caller = state.get("caller") or stranger(line)
        self._records.refused(caller, command, error["code"], one_line(error["message"], 200))


def _set_caller(line: HTTPConnection, caller: Caller) -> None:
    line.scope.setdefault("state", {})["caller"] = caller


def bounded(receive: Receive) -> Receive:
    """Return what receives a body, which may not be large. Raises HTTPException 413."""
    size = 0

    async def part() -> Message:
        nonlocal size
        message = await receive()
        size += len(message.get("body", b""))
        if size > LARGEST_BODY_BYTES:
            raise HTTPException(413, f"the body is larger than {LARGEST_BODY_BYTES} bytes")
        return message

    return part


def _usual(scope: Scope) -> Scope:
    """Return a request as the routes know it: a stop's path without empty parts, and files wanted whole.

    A bad range would be refused in another form than all else.
    """
    path = "/" + "/".join(part for part in scope["path"].split("/") if part)
    is_stop = scope.get("method") == "POST" and path in (*STOPS, TRACK_STOP)
    headers = [one for one in scope["headers"] if one[0] != b"range"]
    return {**scope, "headers": headers, "path": path if is_stop else scope["path"]}
