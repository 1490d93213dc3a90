"""Who comes in: each request gets its caller, by token, by a page's session, or by the way it came."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from mastctl.access.access import Access
from mastctl.access.guesses import neighbourhood
from mastctl.access.tokens import Token, digest_of
from mastctl.commands.caller import NETWORK, Caller, told_name
from mastctl.errors import NotLetIn, TooMany
from mastctl.web.answer import GuardError
from mastctl.web.whose_page import Names

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
