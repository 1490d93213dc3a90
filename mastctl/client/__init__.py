"""A small client of a running daemon."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mastctl.client.client import DEFAULT_URL, AsyncClient, Client
from mastctl.client.connection import ClientError

if TYPE_CHECKING:
    from mastctl.client.snapshot import Snapshot

__all__ = ["DEFAULT_URL", "AsyncClient", "Client", "ClientError", "Snapshot"]


def __getattr__(name: str) -> Any:
    """Load what needs the image library when it is asked for."""
    if name != "Snapshot":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from mastctl.client.snapshot import Snapshot

    return Snapshot
