"""Whose page asks: by which name this daemon was asked for, and from which origin.

Every web page that a browser has open can send requests to whatever the browser's machine reaches. A foreign
name in Host means that a name of somebody else's resolves to this daemon (DNS rebinding). A foreign Origin or
Sec-Fetch-Site means that another site's page asks.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass
from urllib.parse import urlsplit

from mastctl.config import is_loopback
from mastctl.web.answer import GuardError


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
