"""The client of a request: by its token, in a header or a cookie, or by its connection; and its page.

Every web page that a browser has open can send requests to whatever the browser's machine reaches. A foreign
name in Host means that another site's name resolves to this daemon (DNS rebinding). A foreign Origin or
Sec-Fetch-Site means that the request is of another site's page.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

from mastctl.config import is_loopback
from mastctl.control.lease import NETWORK, Caller, client_name
from mastctl.errors import NotAllowed, NotLetIn
from mastctl.http.access import Access
from mastctl.http.tokens import Token


@dataclass(frozen=True)
class HostNames:
    """The names that a daemon answers to, beside the loopback ones, in lower case.

    ``any_address``: any IP address too, which no name server can point elsewhere.
    """

    hosts: frozenset[str] = frozenset()
    any_address: bool = False

    def check_host(self, headers: Mapping[str, str]) -> None:
        """Pass a request for one of these names. Raises NotAllowed ``foreign_host``."""
        host = headers.get("host", "")
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            name = ""
        if is_loopback(name) or name in self.hosts or (self.any_address and _is_address(name)):
            return
        known = ", ".join(sorted(self.hosts)) or "a loopback name such as 127.0.0.1"
        expected = f"{known} is expected (listen.hosts of the configuration)"
        raise NotAllowed("foreign_host", f"Host is '{_shown(host)}' where {expected}")

    def check_origin(self, headers: Mapping[str, str]) -> None:
        """Pass a request that comes from no other site's page. Raises NotAllowed ``foreign_origin``."""
        origin = headers.get("origin")
        if origin is None:
            return
        try:
            parts = urlsplit(origin)
        except ValueError:
            parts = urlsplit("")
        host = headers.get("host", "").lower()
        if not host or parts.netloc.lower() != host or parts.scheme not in SCHEMES:
            message = f"Origin is '{_shown(origin)}', which is not this service"
            raise NotAllowed("foreign_origin", message)


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


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _shown(text: str) -> str:
    return "".join(sign if sign.isprintable() else "?" for sign in text[:80])


SCHEME = "bearer "
SCHEMES = ("http", "https")
"""Of a page of the daemon's own; https by a reverse proxy."""


@dataclass
class EntryRules:
    """A daemon's rules for its clients.

    Without ``access`` every client that reaches it may do everything, ``via`` this machine's ``loopback``
    address under loopback names, or a ``unix`` socket.
    """

    names: HostNames = field(default_factory=HostNames)
    access: Access | None = None
    via: str = "loopback"

    def caller(self, scope: Mapping[str, Any], headers: Mapping[str, str]) -> Caller:
        """Return the caller of a request.

        Raises NotLetIn ``no_token``, ``wrong_token``, NotAllowed ``foreign_origin`` for a page's cookie
        without an Origin where something is changed.
        """
        if self.access is None:
            if by := forwarded(headers):
                reason = f"{by.title()} shows that the request came through a proxy"
                message = (
                    f"{reason}, and this daemon has no tokens: set listen.hosts, so that clients need one"
                )
                raise NotLetIn("no_token", message)
            name = client_name(headers.get("mastctl-client"))
            return Caller(name, "admin", self.via, address_of(scope))
        text, by_cookie = shown_token(scope, headers)
        if text is None:
            raise NotLetIn("no_token", "a token is expected: Authorization: Bearer TOKEN, or a cookie")
        token = self.access.token_of(text)
        if by_cookie and changes(scope) and "origin" not in headers:
            raise NotAllowed("foreign_origin", "a request with the page's cookie carries its Origin")
        return _named(token, scope, headers)

    def stopper(self, scope: Mapping[str, Any], headers: Mapping[str, str]) -> Caller:
        """Return the caller of a stop or of a health check, which every client may request."""
        if self.access is None:
            return self.stranger(scope, headers) if forwarded(headers) else self.caller(scope, headers)
        text, _ = shown_token(scope, headers)
        token = None if text is None else self.access.known(text)
        return self.stranger(scope, headers) if token is None else _named(token, scope, headers)

    def stranger(self, scope: Mapping[str, Any], headers: Mapping[str, str]) -> Caller:
        """Return the caller of a request without a token, or of one that is refused before that is known."""
        return Caller(client_name(headers.get("mastctl-client")), "view", NETWORK, address_of(scope))


def _named(token: Token, scope: Mapping[str, Any], headers: Mapping[str, str]) -> Caller:
    """The caller with a token: the token's name is proven, the one that the program gives itself is not."""
    given = headers.get("mastctl-client")
    name = f"{token.name}/{client_name(given)}" if given else token.name
    return Caller(name, token.role, "token", address_of(scope), token.sha256)


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


FORWARDED = ("forwarded", "via", "x-real-ip", "x-client-ip", "true-client-ip", "cf-connecting-ip")
"""Headers by which a proxy states that a request came from elsewhere, beside all of ``X-Forwarded-...``."""


def changes(scope: Mapping[str, Any]) -> bool:
    """Return whether a request may change something, by its method."""
    return scope["type"] == "http" and scope["method"] not in ("GET", "HEAD", "OPTIONS")
