"""A small client of a running daemon."""

from __future__ import annotations

from mastctl.client.client import DEFAULT_URL, Client, Snapshot
from mastctl.client.connection import ClientError

__all__ = ["DEFAULT_URL", "Client", "ClientError", "Snapshot"]
