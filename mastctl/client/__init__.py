"""A small client of a running daemon."""

from __future__ import annotations

from mastctl.client.client import DEFAULT_URL, Client
from mastctl.client.connection import ClientError
from mastctl.client.snapshot import Snapshot

__all__ = ["DEFAULT_URL", "Client", "ClientError", "Snapshot"]
