"""Heads that answer on a line, and where they report to stand. Only inquiries go out, and nothing moves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

from drivers.clock import Clock, SystemClock, deadlines_on
from drivers.errors import BadOptions
from drivers.serial_line import ByteLine, OpenLine, SerialLine

PATIENCE_S = 0.1  # with a reply, beyond its time on the wire
LONGEST_BYTES = 24  # of a question and its reply

Places = tuple[int, ...]
Question = tuple[bytes, Callable[[bytearray], Places | None]]
"""A frame, and what takes its answer out of a buffer."""


@dataclass(frozen=True)
class Dialect:
    """How heads of one protocol are asked where they stand.

    Attributes
    ----------
    driver, name
        The driver's name, and the protocol's.
    questions
        Those of the head at an address; their answers together are pan and tilt, counts.
    bauds, addresses
        The usual ones, which are asked.
    possible_bauds, highest_address
        What the driver takes.
    schemes
        Of the URLs that the driver opens.
    options
        By which a configuration names the protocol.
    udp
        Opens a ``udp://`` line.
    """

    driver: str
    name: str
    questions: Callable[[int], Sequence[Question]]
    bauds: tuple[int, ...]
    addresses: tuple[int, ...]
    possible_bauds: tuple[int, ...]
    highest_address: int
    schemes: tuple[str, ...]
    options: Mapping[str, Any] = field(default_factory=dict)
    udp: OpenLine | None = None

    def takes(self, port: str) -> bool:
        """Return whether the driver opens such a line."""
        return "://" not in port or port.startswith(self.schemes)


@dataclass(frozen=True)
class FoundHead:
    """A head that answered: in which protocol, at which rate and address, and where it stands, counts."""

    dialect: Dialect
    baud: int
    address: int
    places: Places

    @property
    def words(self) -> str:
        """What it is."""
        pan, tilt = self.places
        at = f"(address {self.address}, {self.baud} baud)"
        return f"a {self.dialect.name} head {at}, at {pan} and {tilt} counts"


def find_heads(
    port: str,
    dialects: Sequence[Dialect],
    bauds: Sequence[int] = (),
    addresses: Sequence[int] = (),
    clock: Clock | None = None,
    open_line: OpenLine = SerialLine,
) -> list[FoundHead]:
    """Return the heads that answer, of the first protocol and rate at which one does.

    Parameters
    ----------
    port
        The line.
    dialects
        The protocols, in the order in which they are asked.
    bauds, addresses
        To ask at instead of the usual ones, as far as a protocol has them.
    clock, open_line
        Of the line.

    Raises
    ------
    LineLost
        If the line cannot be opened.
    """
    time = deadlines_on(clock or SystemClock())
    for dialect in dialects:
        if not dialect.takes(port):
            continue
        opens = dialect.udp if dialect.udp is not None and port.startswith("udp://") else open_line
        rates = [baud for baud in bauds or dialect.bauds if baud in dialect.possible_bauds]
        there = [one for one in addresses or dialect.addresses if 1 <= one <= dialect.highest_address]
        for baud in rates[:1] if port.startswith(("udp://", "socket://")) else rates:
            try:
                line = opens(port, baud, dialect.driver)
            except BadOptions:
                continue  # a rate that the adapter does not have
            with closing(line):
                asked = ((one, _places(line, dialect.questions(one), time)) for one in there)
                found = [FoundHead(dialect, baud, one, places) for one, places in asked if places is not None]
            if found:
                return found
    return []


def _places(line: ByteLine, questions: Sequence[Question], clock: Clock) -> Places | None:
    """Where a head stands that answers two times; what is taken for an answer on a bad line seldom does."""
    places: Places = ()
    for frame, take in 2 * tuple(questions):
        answer = _answer(line, frame, take, clock)
        if answer is None:
            return None
        places += answer
    return places[-2:]


def _answer(
    line: ByteLine, frame: bytes, take: Callable[[bytearray], Places | None], clock: Clock
) -> Places | None:
    line.read(0.0)
    line.write(frame)
    buffer = bytearray()
    until_s = clock.now_s() + PATIENCE_S + LONGEST_BYTES * line.byte_s
    while (left_s := until_s - clock.now_s()) > 0:
        buffer += line.read(left_s)
        if (answer := take(buffer)) is not None:
            return answer
    return None
