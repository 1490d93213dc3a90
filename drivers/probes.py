"""What a driver's ``probe`` finds without a configuration, and its ``bench``: work without a daemon."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Ends = Mapping[str, tuple[float, float]]
"""The ends of pan and tilt, radians."""


class ProbedHead(ABC):
    """A head that answered on a line.

    ``usable``: whether it can be the head of a configuration.
    """

    driver: str
    port: str
    usable: bool = True
    speed_rad_per_s: float = 0.5

    @property
    @abstractmethod
    def summary(self) -> str:
        """What it is, in one sentence."""

    @abstractmethod
    def configured(self, ends: Ends, ids: Mapping[str, int]) -> tuple[dict[str, Any], Ends]:
        """Return its options without the port, and the ends that it can reach.

        ``ids`` are those of the servos of pan and tilt.
        """


@dataclass(frozen=True)
class ProbedCamera:
    """A camera that has a format that is read.

    ``node`` is its node now, which udev knows; None for a camera without one.
    """

    card: str
    bus: str
    node: Path | None
    options: dict[str, Any]
    driver: str

    @property
    def summary(self) -> str:
        """What it is, in one sentence."""
        width, height = self.options["size_px"]
        return f"{self.card} at {self.bus}: {self.options['format']} {width}x{height}"


@dataclass(frozen=True)
class UnitBench:
    """What is done with a pan/tilt unit on the bench.

    Attributes
    ----------
    bauds
        The rates of its line, the usual one first.
    facts, home
        ``facts(port, baud)`` returns what the unit reports; so does ``home``, after a reset.
    """

    bauds: Sequence[int]
    facts: Callable[[str, int], Any]
    home: Callable[[str, int], Any]


@dataclass(frozen=True)
class CameraBench:
    """What is done with a camera that no daemon has.

    Attributes
    ----------
    key, title
        Of the table of connected cameras, in JSON and for people.
    table
        The connected cameras, each as column and text or list of texts, and a sentence for each that this
        user may not open.
    present
        ``present(options, name)`` says which camera has answered; no stream is begun. Raises DriverError.
    options_for
        Options of a camera that a person names at the command line; None where only a configuration does.
    """

    key: str
    title: str
    table: Callable[[], tuple[list[dict[str, Any]], list[str]]]
    present: Callable[[Mapping[str, Any], str], str]
    options_for: Callable[..., dict[str, Any]] | None = None
