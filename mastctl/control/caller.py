"""The client of a request: its name, its rights, and how it came."""

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
    """The client of a request. Equal callers are one party.

    Attributes
    ----------
    name
        As given by the client, for people and for the record; it proves nothing.
    role
        Its rights. On the path that needs no token every client is ``admin``.
    via
        ``loopback``, ``unix``, ``token``, ``inside`` (this process itself), ``network`` (a stranger without a
        valid token).
    address
        The address it came from; empty from inside.
    credential
        Digest of its token; empty without one.
    """

    name: str = ANONYMOUS
    role: Role = "admin"
    via: str = "loopback"
    address: str = field(default="", compare=False)
    credential: str = field(default="", compare=False, repr=False)

    @property
    def stranger(self) -> bool:
        """Whether only its address is known."""
        return self.via == NETWORK

    def may(self, role: Role) -> bool:
        """Return whether it has the rights of ``role``."""
        return ROLES.index(self.role) >= ROLES.index(role)

    def check_may(self, role: Role, command: str) -> None:
        """Pass a client with the rights of ``role``. Raises NotAllowed ``role``."""
        if not self.may(role):
            raise NotAllowed("role", f"{self.name} may {self.role}; {command} needs the role {role}")


def client_name(header: str | None) -> str:
    """Return the name that a client gives itself as one printable line of 80 characters at most.

    `ANONYMOUS` for an empty one. Headers are read as Latin-1, and as UTF-8 where that is possible. Never
    refuses: a stop with a strange name is a stop.
    """
    name = header or ""
    with contextlib.suppress(UnicodeError):
        name = name.encode("latin-1").decode()
    return one_line(name, LONGEST_NAME).strip() or ANONYMOUS
