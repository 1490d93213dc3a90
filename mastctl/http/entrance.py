"""Who comes in, and whose page asks: a caller by token, by a page's session, or by the way it came.

Every web page that a browser has open can send requests to whatever the browser's machine reaches. A foreign
name in Host means that a name of somebody else's resolves to this daemon (DNS rebinding). A foreign Origin or
Sec-Fetch-Site means that another site's page asks.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

from mastctl.config import is_loopback
from mastctl.control.caller import NETWORK, Caller, told_name
from mastctl.errors import NotLetIn, TooMany
from mastctl.http.access import Access, neighbourhood
from mastctl.http.refusals import GuardError
from mastctl.http.tokens import Token, digest_of


@dataclass(frozen=True)
class Names:
    """The names that a daemon answers to.

    Attributes
    ----------
    hosts
        Beside the loopback ones, in lower case.
    any_address
        Whether any IP address will do as one: what no name server can point elsewhere.
    secure
        Whether it speaks TLS itself.
    """

    hosts: frozenset[str] = frozenset()
    any_address: bool = False
    secure: bool = False

    def check_host(self, headers: Mapping[str, str]) -> None:
        """Pass a request for one of these names. Raises GuardError ``foreign_host``."""
        host = headers.get("host", "")
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            name = ""
        if is_loopback(name) or name in self.hosts or (self.any_address and _is_address(name)):
            return
        known = ", ".join(sorted(self.hosts)) or "a loopback name such as 127.0.0.1"
        words = f"Host is '{_shown(host)}' where {known} is expected (listen.hosts of the configuration)"
        raise GuardError(403, "foreign_host", words)

    def check_origin(self, headers: Mapping[str, str]) -> None:
        """Pass a request that comes from no other site's page. Raises GuardError ``foreign_origin``."""
        origin = headers.get("origin")
        if origin is None:
            return
        try:
            parts = urlsplit(origin)
        except ValueError:
            parts = urlsplit("")
        schemes = ("https",) if self.secure else ("http", "https")  # https: by a proxy of this machine
        host = headers.get("host", "").lower()
        if not host or parts.netloc.lower() != host or parts.scheme not in schemes:
            words = f"Origin is '{_shown(origin)}', which is not this service"
            raise GuardError(403, "foreign_origin", words)


def check_site(headers: Mapping[str, str], *, page: bool = False) -> None:
    """Pass what a browser does not say another site's page asks for.

    Parameters
    ----------
    page
        Whether it is a page, to which others may lead.

    Raises
    ------
    GuardError
        ``foreign_origin``.
    """
    site = headers.get("sec-fetch-site", "none").lower()
    if site in ("same-origin", "none"):
        return
    if page and headers.get("sec-fetch-mode") == "navigate" and headers.get("sec-fetch-dest") == "document":
        return
    words = f"Sec-Fetch-Site is '{_shown(site)}': only the service's own page may ask for this"
    raise GuardError(403, "foreign_origin", words)


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _shown(text: str) -> str:
    return "".join(sign if sign.isprintable() else "?" for sign in text[:80])


SCHEME = "bearer "
MOST_REQUESTS_PER_S = 1000


@dataclass(frozen=True)
class Credentials:
    """What a request shows: a token, a session's secret, or nothing."""

    token: str | None
    session: str | None


@dataclass
class Entrance:
    """What a daemon asks of who comes in.

    Attributes
    ----------
    names
        The names it answers to.
    access
        Its tokens; None where everybody who reaches it may do everything: this machine's loopback address
        under loopback names, or a Unix socket.
    via
        That way: ``loopback`` or ``unix``.
    """

    names: Names = field(default_factory=Names)
    access: Access | None = None
    via: str = "loopback"

    def caller(self, scope: Mapping[str, Any], headers: Mapping[str, str]) -> Caller:
        """Return who asks.

        Raises
        ------
        NotLetIn, TooMany
            ``no_token``, ``wrong_token``, ``too_many_guesses``.
        GuardError
            ``foreign_origin`` for a page's session without an Origin where something is changed.
        """
        if self.access is None:
            name = told_name(headers.get("mastctl-client"))
            return Caller(name, "admin", self.via, address_of(scope))
        shown = credentials(scope, headers)
        token = self._token(shown, address_of(scope))
        if shown.token is None and changes(scope) and "origin" not in headers:
            raise GuardError(403, "foreign_origin", "a page's session says its Origin")
        return _named(token, shown, scope, headers)

    def stopper(self, scope: Mapping[str, Any], headers: Mapping[str, str]) -> Caller:
        """Return who asks for a stop: anybody may. Nothing is counted and nothing is logged on this way."""
        if self.access is None:
            return self.caller(scope, headers)
        shown = credentials(scope, headers)
        held = None if shown.session is None else self.access.session_of(shown.session)
        token = self.access.known(shown.token) if shown.token is not None else held[0] if held else None
        return self.stranger(scope, headers) if token is None else _named(token, shown, scope, headers)

    def stranger(self, scope: Mapping[str, Any], headers: Mapping[str, str]) -> Caller:
        """Return who asks without a token what needs none, or is refused before it is known."""
        return Caller(told_name(headers.get("mastctl-client")), "view", NETWORK, address_of(scope))

    def _token(self, shown: Credentials, address: str) -> Token:
        assert self.access is not None
        if shown.token is not None:
            return self.access.token_of(shown.token, address)
        if shown.session is not None:
            held = self.access.session_of(shown.session)
            if held is not None:
                return held[0]
            raise NotLetIn("no_token", "the session has ended; log in again")
        raise NotLetIn("no_token", "a token is expected: Authorization: Bearer TOKEN, or POST /api/v1/login")


def _named(token: Token, shown: Credentials, scope: Mapping[str, Any], headers: Mapping[str, str]) -> Caller:
    """Who shows a token: its name, which is proven, and what the program calls itself, which is not."""
    told = headers.get("mastctl-client")
    name = f"{token.name}/{told_name(told)}" if told else token.name
    credential = token.sha256 if shown.token is not None else digest_of(shown.session or "")
    return Caller(name, token.role, "token", address_of(scope), credential)


class Rate:
    """How many requests each address sends in a second; used on one thread."""

    def __init__(self) -> None:
        self._second = -1
        self._counts: dict[str, int] = {}

    def count(self, scope: Mapping[str, Any], now_s: float) -> None:
        """Count a request. Raises TooMany ``too_many_requests``."""
        if int(now_s) != self._second:
            self._second = int(now_s)
            self._counts.clear()
        address = neighbourhood(address_of(scope))
        counted = self._counts[address] = self._counts.get(address, 0) + 1
        if counted > MOST_REQUESTS_PER_S:
            words = f"more than {MOST_REQUESTS_PER_S} requests a second; ask more slowly"
            raise TooMany("too_many_requests", words, 1.0)


def credentials(scope: Mapping[str, Any], headers: Mapping[str, str]) -> Credentials:
    """Return what a request shows; a token goes before a session."""
    told = headers.get("authorization", "")
    token = told[len(SCHEME) :].strip() if told[: len(SCHEME)].lower() == SCHEME else None
    name = cookie_name(scope)
    parts = [part.strip().partition("=") for part in headers.get("cookie", "").split(";")]
    secrets = [value for key, _, value in parts if key == name]
    return Credentials(token, secrets[0] if len(secrets) == 1 else None)


def cookie_name(scope: Mapping[str, Any]) -> str:
    """Return the cookie of a page's session: one for each port, as browsers do not tell ports apart."""
    server = scope.get("server")
    port = server[1] if server else None
    return f"mastctl-{port}" if port else "mastctl"


def address_of(scope: Mapping[str, Any]) -> str:
    """Return the address that a request came from; what headers say of it is not asked."""
    client = scope.get("client")
    return str(client[0]) if client else "a socket of this machine"


def changes(scope: Mapping[str, Any]) -> bool:
    """Return whether a request may change something, by its method."""
    return scope["type"] == "http" and scope["method"] not in ("GET", "HEAD", "OPTIONS")
