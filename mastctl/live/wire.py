"""What the daemon and its server for viewers send each other."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Open:
    """Offer a topic."""

    topic: str
    encoding: str
    schema_name: str
    schema_encoding: str
    schema: bytes


@dataclass(frozen=True)
class Close:
    """Offer a topic no longer."""

    topic: str


@dataclass(frozen=True)
class Message:
    """Show a message of an open topic."""

    topic: str
    data: bytes
    time_ns: int


@dataclass(frozen=True)
class Listening:
    """The answer to being started; ``refused`` says why it does not listen."""

    port: int = 0
    refused: str = ""


@dataclass(frozen=True)
class Watched:
    """Which topics somebody watches."""

    topics: frozenset[str]
