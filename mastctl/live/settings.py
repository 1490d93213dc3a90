"""What a configuration says about the live view; read strictly by `mastctl.config`."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LiveSettings:
    """Where viewers connect: a loopback address, and a port (0: any free one)."""

    host: str = "127.0.0.1"
    port: int = 8765
