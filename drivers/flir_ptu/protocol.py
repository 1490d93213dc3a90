"""The requests to a unit and its replies, line by line: answers, errors, limit hits before any of them.

From the manuals (PTU-D46 v2.14, section 4.2; E series v6.00): a command that succeeds is answered ``*``, a
query ``* <text>``, a failure ``! <words>``, each ended by CR or LF or both. An axis that runs into a limit
switch puts ``!P`` or ``!T`` in between whenever it happens; a reset gives ``!T!T!P!P*``. With echo on the
command itself stands first: ``PP * Current Pan position is 22``.

The protocol has no checksum. So a line counts only if all of it fits. The echo is the command that was sent,
the terms are those of the requested quantity, and there is one number and nothing else with digits.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

# No space follows the "!", as it does in an error; an echo may, which never begins with two small letters.
_HIT = re.compile(rb"\s*!([PTpt])(?![a-z]{2})")
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?\Z")
_LONGEST_LINE = 400


@dataclass(frozen=True)
class Query:
    """A question with a number for an answer: its letters, and terms of its verbose answer."""

    letters: str
    terms: tuple[str, ...]


def _axis_query(letter: str, *terms: str) -> dict[str, Query]:
    """The same question for both axes."""
    return {
        axis: Query(axis[0].upper() + letter, tuple(axis if word == "AXIS" else word for word in terms))
        for axis in ("pan", "tilt")
    }


POSITION = _axis_query("P", "current", "AXIS", "position")
RESOLUTION = _axis_query("R", "arc", "position")  # the E series does not say of which axis
LOWEST = _axis_query("N", "minimum", "AXIS", "position")
HIGHEST = _axis_query("X", "maximum", "AXIS", "position")
SPEED = _axis_query("S", "AXIS", "speed")
FASTEST = _axis_query("U", "maximum", "AXIS", "speed")
SLOWEST = _axis_query("L", "minimum", "AXIS", "speed")
ACCELERATION = _axis_query("A", "AXIS", "acceleration")


@dataclass(frozen=True)
class PtuAnswer:
    """One answer of the unit: ``*`` (good) or ``!``, with an echo of the command or without.

    ``exact``: whether the echo is so letter by letter, capitals and small ones.
    """

    good: bool
    text: str
    echo: bool
    exact: bool = False


class LineSplitter:
    """Cuts a stream of bytes into lines, whatever the pieces it comes in."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Return the lines that are now complete, without their ends and without empty ones."""
        *whole, self._rest = re.split(rb"[\r\n]", self._rest + data)
        self._rest = self._rest[-_LONGEST_LINE:]
        return [line for line in whole if line.strip()]

    def clear(self) -> bytes:
        """Forget and return the unfinished line."""
        rest, self._rest = self._rest, b""
        return rest


def hits_of(line: bytes) -> tuple[str, ...]:
    """Return the axes, ``pan`` or ``tilt``, whose limit hits stand anywhere in a line."""
    found = re.findall(rb"!([PTpt])(?![a-z]{2})", line)
    return tuple("pan" if letter in b"Pp" else "tilt" for letter in found)


def answer_of(line: bytes, command: str) -> PtuAnswer | None:
    """Return a line's answer to a command; None if it is not one.

    The ``line`` comes without its end; limit hits in it are passed over.
    """
    rest, echo, exact = without_hits(line), False, False
    if not all(32 <= byte < 127 for byte in rest):
        return None
    sent = command.encode("ascii")
    if rest[: len(sent)].upper() == sent.upper() and not rest.startswith((b"*", b"!")):
        exact = rest.startswith(sent)
        rest, echo = without_hits(rest[len(sent) :]), True
    if rest.strip() == b"*":
        return PtuAnswer(True, "", echo, exact)
    if rest.startswith((b"* ", b"! ")):
        return PtuAnswer(rest.startswith(b"*"), rest[2:].decode("ascii").strip(), echo, exact)
    return None


def number_of(text: str, terms: tuple[str, ...], verbose: bool) -> float | None:
    """Return the one number in a query's answer; None if the answer is not to that query.

    A ``verbose`` answer holds lower-case ``terms``, such as current, pan, position; a terse one is the number
    alone.
    """
    tokens = text.split()
    if not verbose:
        return float(text) if _NUMBER.match(text) else None
    numbers = [token for token in tokens if _NUMBER.match(token)]
    others = [token.lower().replace("sec^2", "") for token in tokens if not _NUMBER.match(token)]
    if len(numbers) != 1 or any(character.isdigit() for token in others for character in token):
        return None
    return float(numbers[0]) if set(terms) <= set(others) else None


def without_hits(data: bytes) -> bytes:
    """Return bytes without the limit hits and spaces in front of them."""
    while found := _HIT.match(data):
        data = data[found.end() :]
    return data.strip()
