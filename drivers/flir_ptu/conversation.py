"""One question at a time with a unit: each answer is matched to its question, or is not taken at all.

The answer to a question is the next line that fits it, within a deadline of the monotonic clock. A line that
does not fit is an error, never skipped in silence. After any error the two sides may be out of step: an
answer may still be under way. Then nothing is asked before `in_step` has let the line fall quiet and has
asked the resolutions of both axes, whose words no other answer has: since a unit answers in order, whatever
was under way has come by then and was thrown away. The resolutions also tell a reset or another step mode.

At the start the unit is asked for words and echo (``FV``, ``EE``), because both say which question an answer
belongs to. One that stays terse or without echo is understood too.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

from drivers.errors import BadReply, NoReply, Refused
from drivers.flir_ptu.line import Line
from drivers.flir_ptu.replies import Answer, LineSplitter, answer_of, hits_of, number_of, without_hits

REPLY_S = 0.3
"""How long a unit may think before its answer is complete, beyond the time the bytes take on the wire."""
REPLY_BYTES = 70  # a command, its echo and the longest answer in words
QUIET_S = 0.06
LONGEST_DRAIN_S = 0.4
PATIENT_TRIES = 3
STEP_TRIES = 2


@dataclass(frozen=True)
class Query:
    """A question with a number for an answer: its letters, and words of its verbose answer."""

    letters: str
    words: tuple[str, ...]


def _axis_query(letter: str, *words: str) -> dict[str, Query]:
    """The same question for both axes."""
    return {
        axis: Query(axis[0].upper() + letter, tuple(axis if word == "AXIS" else word for word in words))
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
class _Manners:
    """How a unit answers: in words, and with an echo of the command."""

    verbose: bool | None = None
    echo: bool | None = None


class Conversation:
    """The questions and answers on one open line; for one thread at a time.

    Parameters
    ----------
    line
        Open; closed by `close`.
    device
        The head's name in errors.
    on_hit
        Told the axis, ``pan`` or ``tilt``, whenever a limit hit comes that nobody asked for.
    """

    def __init__(self, line: Line, device: str, on_hit: Callable[[str], None]) -> None:
        self._line = line
        self._device = device
        self._on_hit = on_hit
        self._splitter = LineSplitter()
        self._lines: deque[bytes] = deque()
        self._manners = _Manners()
        self._in_step = False
        self._tries = 1
        self.byte_s = line.byte_s
        self.reply_s = REPLY_S + REPLY_BYTES * line.byte_s

    @property
    def is_in_step(self) -> bool:
        """Whether the last exchange ended as it should."""
        return self._in_step

    def in_step(self) -> dict[str, float]:
        """Throw away what is under way, and return the resolutions, seconds of arc a position.

        Raises
        ------
        NoReply
            If the unit does not answer.
        Refused
            If it does not know its resolution, as an E46 before its first reset.
        LineLost
            If the line is gone.
        """
        self._quiet()
        found, manners = self._resolutions()
        if manners != self._manners:  # the first time, and after a power cycle
            for command in ("FV", "EE"):
                self._line.send(f"{command} ".encode())
                self._next_answer(command, time.monotonic() + self.reply_s, skip=True)
                self._quiet()
            found, self._manners = self._resolutions()
        self._in_step = True
        return found

    def ask(self, query: Query) -> float:
        """Return the number that answers a query.

        Raises
        ------
        NoReply
            If the answer did not come in time.
        BadReply
            If something came that is not its answer.
        Refused
            If the unit will not.
        LineLost
            If the line is gone.
        """
        text = self._exchange(query.letters, self.reply_s)
        number = number_of(text, query.words, bool(self._manners.verbose))
        if number is None:
            self._in_step = False
            raise BadReply(f"answered {query.letters} with '{text[:80]}'", device=self._device)
        return number

    def tell(self, command: str, patience_s: float = 0.0) -> str:
        """Send a command and return the text of its answer, mostly empty.

        ``patience_s`` is what the unit may need beyond the usual time. Raises as `ask`.
        """
        return self._exchange(command, self.reply_s + patience_s)

    def reset(self, patience_s: float) -> None:
        """Have the unit find its limits again (``R``): both axes sweep their full range.

        Raises
        ------
        NoReply
            If it is not done within ``patience_s`` seconds.
        Refused, LineLost
            If the unit will not, or is gone.
        """
        self._quiet()
        self._line.send(b"R ")
        answer = self._next_answer("R", time.monotonic() + patience_s, skip=True)
        if not answer.good:
            raise Refused(f"refuses R: {answer.text or 'without words'}", device=self._device)

    def shout(self, command: str) -> None:
        """Send a command beside whatever is under way, from any thread; its answer upsets the other exchange.

        Raises LineLost.
        """
        self._line.send(f"{command} ".encode())

    def close(self) -> None:
        """Close the line."""
        self._line.close()

    @contextmanager
    def patient(self) -> Iterator[None]:
        """Within this, what was not answered as it should be is asked again, some times."""
        self._tries = PATIENT_TRIES
        try:
            yield
        finally:
            self._tries = 1

    def _exchange(self, command: str, patience_s: float) -> str:
        """Send a command and return the text of its answer."""
        for _ in range(1, self._tries):
            try:
                return self._exchange_once(command, patience_s)
            except (NoReply, BadReply):
                self.in_step()
        return self._exchange_once(command, patience_s)

    def _exchange_once(self, command: str, patience_s: float) -> str:
        """The same, one time; on any error the two sides are out of step."""
        if not self._in_step:
            raise BadReply("is out of step with this program", device=self._device)
        self._in_step = False
        for line in self._splitter.feed(self._line.pending()):
            self._note_hits(line)  # whatever else it says, nobody waits for it
        begun = self._splitter.clear()
        self._note_hits(begun)
        if without_hits(begun):
            raise BadReply(f"was in the middle of saying {_shown(begun)}", device=self._device)
        self._lines.clear()
        self._line.send(f"{command} ".encode())
        answer = self._next_answer(command, time.monotonic() + patience_s, skip=False)
        if self._manners.echo and not answer.echo:
            raise BadReply(f"answered {command} without its echo", device=self._device)
        self._in_step = True
        if not answer.good:
            raise Refused(f"refuses {command}: {answer.text or 'without words'}", device=self._device)
        return answer.text

    def _resolutions(self) -> tuple[dict[str, float], _Manners]:
        """The resolution of each axis, whatever else comes in between, and how the unit answered."""
        found = {}
        manners = _Manners()
        for axis, query in RESOLUTION.items():
            for tries_left in reversed(range(STEP_TRIES)):
                try:
                    found[axis], manners = self._resolution(axis, query)
                    break
                except NoReply:
                    if not tries_left:
                        raise
        return found, manners

    def _resolution(self, axis: str, query: Query) -> tuple[float, _Manners]:
        """One of them, and how the unit answered."""
        self._line.send(f"{query.letters} ".encode())
        until_s = time.monotonic() + self.reply_s
        refusal = ""
        while True:
            try:
                answer = self._next_answer(query.letters, until_s, skip=True)
            except NoReply:
                if refusal:
                    words = f"does not tell its {axis} resolution: {refusal}"
                    raise Refused(words, device=self._device) from None
                raise
            other = {"pan": "tilt", "tilt": "pan"}[axis]
            number = number_of(answer.text, query.words, " " in answer.text) if answer.good else None
            if other in answer.text.lower().split():
                number = None
            if number is not None:
                return number, _Manners(" " in answer.text, answer.echo)
            if not answer.good:
                refusal = answer.text

    def _next_answer(self, command: str, until_s: float, skip: bool) -> Answer:
        """The next answer; a line that is none is an error unless such lines are to be skipped."""
        echo = False
        while True:
            line = self._next_line(command, until_s)
            answer = answer_of(line, command)
            if answer is not None:
                return replace(answer, echo=answer.echo or echo)
            if without_hits(line).upper() == command.encode("ascii"):
                echo = True  # on a line of its own, as the E series has it
            elif not skip and without_hits(line):
                raise BadReply(f"answered {command} with {_shown(line)}", device=self._device)

    def _next_line(self, command: str, until_s: float) -> bytes:
        """The next complete line."""
        while not self._lines:
            data = self._line.receive(until_s)
            for line in self._splitter.feed(data):
                self._note_hits(line)
                self._lines.append(line)
            if not self._lines and time.monotonic() >= until_s:
                raise NoReply(f"did not answer {command} within its deadline", device=self._device)
        return self._lines.popleft()

    def _quiet(self) -> None:
        """Throw away what comes until nothing has come for a while; limit hits are noted."""
        self._in_step = False
        until_s = time.monotonic() + LONGEST_DRAIN_S
        while time.monotonic() < until_s:
            data = self._line.receive(time.monotonic() + QUIET_S)
            if not data:
                break
            for line in self._splitter.feed(data):
                self._note_hits(line)
        self._note_hits(self._splitter.clear())
        self._lines.clear()

    def _note_hits(self, data: bytes) -> None:
        for axis in hits_of(data):
            self._on_hit(axis)


def _shown(line: bytes) -> str:
    """A line as text for people."""
    return repr(line[:80].decode("ascii", "backslashreplace"))
