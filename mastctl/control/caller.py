"""Who asks: a name, what it may do, and the way it came."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field

from mastctl.answers import Role
from mastctl.errors import NotAllowed, one_line

ROLES: tuple[Role, ...] = ("view", "operate", "admin")

ANONYMOUS = "anonymous"
LONGEST_NAME = 80
NETWORK = "network"


@dataclass(frozen=True)
class Caller:
    """Who asks for something. Equal callers are one party.

    Attributes
    ----------
    name
        As told by the caller, for people and for the record; it proves nothing.
    role
        What it may do. On the way that needs no token everybody is ``admin``.
    via
        The way it came: ``loopback``, ``unix``, ``token``, ``inside`` (this process itself), ``network``
        (a stranger, who showed nothing that is known).
    address
        Where it came from; empty where it came from inside.
    credential
        Digest of the token or the session that it showed; empty for none.
    """

    name: str = ANONYMOUS
    role: Role = "admin"
    via: str = "loopback"
    address: str = field(default="", compare=False)
    credential: str = field(default="", compare=False, repr=False)

    @property
    def stranger(self) -> bool:
        """Whether nothing is known of it but its address."""
        return self.via == NETWORK

    def may(self, role: Role) -> bool:
        """Return whether it may do what ``role`` may."""
        return ROLES.index(self.role) >= ROLES.index(role)

    def check_may(self, role: Role, what: str) -> None:
        """Pass who may do what ``role`` may. Raises NotAllowed ``role``."""
        if not self.may(role):
            raise NotAllowed("role", f"{self.name} may {self.role}; {what} needs the role {role}")


def told_name(header: str | None) -> str:
    """Return what a caller calls itself as one printable line, cut to 80 signs; `ANONYMOUS` for nothing.

    Headers are read as Latin-1; what is UTF-8 in one is told as that. Never refuses: a stop with a strange
    name is a stop.
    """
    told = header or ""
    with contextlib.suppress(UnicodeError):  # what is no UTF-8 is told as it came
        told = told.encode("latin-1").decode()
    return one_line(told, LONGEST_NAME).strip() or ANONYMOUS
