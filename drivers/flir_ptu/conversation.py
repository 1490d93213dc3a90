"""One question at a time with a unit: each answer is matched to its question, or is not taken at all.

The answer to a question is the next line that fits it, within a deadline of the clock. A line that does not
fit is an error, never skipped in silence, unless it is the last answer once more. After any error the two
sides may be out of step: an answer may still be under way. Then nothing is requested before `in_step` has let
the line fall quiet and has read the resolutions of both axes, whose terms no other answer has. A unit answers
in order, so everything under way has come by then and was thrown away. The resolutions also show a reset or
another step mode.

At the start the unit is set to terms and echo (``FV``, ``EE``), because both say which question an answer
belongs to. A unit ignores the case of letters, but echoes it. So each command is written otherwise than the
last one (``PP``, ``Pp``, ``pP``), and the echo shows which of several alike is answered. One that stays terse
or without such an echo is understood too; it is listened to for longer after an error.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TypeVar

from drivers.clock import Clock
from drivers.errors import BadReply, DriverError, NoReply, Refused
from drivers.flir_ptu.protocol import (
    RESOLUTION,
    LineSplitter,
    PtuAnswer,
    Query,
    answer_of,
    hits_of,
    number_of,
    without_hits,
)
from drivers.serial_line import ByteLine

T = TypeVar("T")

REPLY_S = 0.3
"""How long a unit may think before its answer is complete, beyond the time the bytes take on the wire."""
REPLY_BYTES = 70  # a command, its echo and the longest verbose answer
QUIET_S = 0.06
LONGEST_DRAIN_S = 0.4
PATIENT_TRIES = 3
STEP_TRIES = 3
AGREEING_TRIES = 5
ORDER_S = 0.01  # how long a halt waits for another thread's write


class StopCameFirst(DriverError):
    """Something was sent at once meanwhile; the command was not sent, and its caller gives way."""

    code = "interrupted"


@dataclass(frozen=True)
class _Manners:
    """How a unit answers: in sentences, with an echo of the command, and with one letter by letter."""

    verbose: bool | None = None
    echo: bool | None = None
    exact: bool | None = None


class Conversation:
    """The questions and answers on one open line; for one thread at a time.

    ``on_hit`` is called with the axis, ``pan`` or ``tilt``, whenever an unrequested limit hit comes.
    ``gives_way``: whether no question is sent any more after something was sent at once.
    """

    def __init__(self, line: ByteLine, device: str, on_hit: Callable[[str], None], clock: Clock) -> None:
        self._line = line
        self._clock = clock
        self._device = device
        self._on_hit = on_hit
        self._splitter = LineSplitter()
        self._lines: deque[bytes] = deque()
        self._manners = _Manners()
        self._in_step = False
        self._tries = 1
        self._turn = 0
        self._last_written = ""
        self._order = threading.Lock()  # no question goes out between what is sent at once and its answer
        self._unanswered = 0  # whose answers are still to come
        self.gives_way = True
        self._answered = b""  # the last line that was taken for an answer
        self.byte_s = line.byte_s
        self.reply_s = REPLY_S + REPLY_BYTES * line.byte_s

    @property
    def is_in_step(self) -> bool:
        """Whether the last exchange ended as it should."""
        return self._in_step

    def in_step(self) -> dict[str, float]:
        """Throw away what is under way, and return the resolutions, seconds of arc a position.

        Raises Refused if it does not know its resolution, as an E46 before its first reset; NoReply,
        LineLost.
        """
        self._quiet()
        found, manners = self._resolutions()
        if manners != self._manners:  # the first time, and after a power cycle
            for command in ("FV", "EE"):
                self._line.write(f"{command} ".encode())
                self._next_answer(command, self._clock.now_s() + self.reply_s, skip=True)
                self._quiet()
            found, self._manners = self._resolutions()
        self._in_step = True
        return found

    def value_of(self, query: Query) -> float:
        """Return the number that answers a query.

        Raises NoReply if the answer did not come in time; BadReply if something came that is not its answer;
        Refused if the unit will not; LineLost.
        """
        text = self._exchange(query.letters, self.reply_s)
        number = number_of(text, query.terms, bool(self._manners.verbose))
        if number is None:
            self._in_step = False
            raise BadReply(f"answered {query.letters} with '{text[:80]}'", device=self._device)
        return number

    def sure(self, query: Query, first: float | None = None) -> float:
        """Return the number that answers a query twice in a row; ``first`` is an earlier answer.

        For values that are read once and then used all the time: the protocol has no checksum. Raises as
        `value_of`, and BadReply if no two answers are the same.
        """
        return self._twice(query.letters, lambda: self.value_of(query), first)

    def sure_text(self, command: str) -> str:
        """Return the text that answers a command twice in a row; raises as `sure`."""
        return self._twice(command, lambda: self.request(command), None)

    def _twice(self, command: str, value_of: Callable[[], T], before: T | None) -> T:
        """The first of the answers that is the same as the one before it."""
        answers: list[T] = [] if before is None else [before]
        while len(answers) < AGREEING_TRIES:
            answers.append(value_of())
            if len(answers) > 1 and answers[-1] == answers[-2]:
                return answers[-1]
        found = ", ".join(f"'{str(one)[:40]}'" for one in answers)
        raise BadReply(f"answers {command} otherwise each time: {found}", device=self._device)

    def request(self, command: str, patience_s: float = 0.0) -> str:
        """Send a command and return the text of its answer, mostly empty.

        ``patience_s`` is what the unit may need beyond the usual time. Raises as `value_of`.
        """
        return self._exchange(command, self.reply_s + patience_s)

    def reset(self, patience_s: float) -> None:
        """Have the unit find its limits again (``R``): both axes sweep their full range.

        Raises NoReply if it is not done within ``patience_s`` seconds; Refused, LineLost if the unit will
        not, or is gone.
        """
        self._quiet()
        self._line.write(b"R ")
        answer = self._next_answer("R", self._clock.now_s() + patience_s, skip=True)
        if not answer.good:
            raise Refused(f"refuses R: {answer.text or 'without a reason'}", device=self._device)

    def send_at_once(self, command: str) -> None:
        """Send a command beside a call under way, from any thread.

        That call gets its answer, and `StopCameFirst` with its next question; then `sent_at_once` takes
        this one's. Raises LineLost.
        """
        ordered = self._order.acquire(timeout=ORDER_S)
        try:
            self._unanswered += 1
            self._line.write(f"{command} ".encode())
        finally:
            if ordered:
                self._order.release()

    def sent_at_once(self, command: str) -> bool:
        """Take the answer of what was sent at once; return whether it was a good one, and nothing else came.

        A unit answers in order, and echoes letter by letter which question it answers: so both sides are in
        step still. If anything is otherwise, or nothing was sent at once, `request` it. Raises LineLost.
        """
        if not (self._unanswered and self._in_step and self._manners.exact):
            return False
        self._in_step = False
        while self._unanswered:
            self._answered, self._last_written = b"", command  # two stops have the same answer
            try:
                answer = self._next_answer(command, self._clock.now_s() + self.reply_s, skip=False)
            except (NoReply, BadReply):
                return False
            if not (answer.good and answer.exact):
                return False
            with self._order:
                self._unanswered -= 1
        self._answered = b""
        self._in_step = True
        return True

    def close(self) -> None:
        """Close the line."""
        self._line.close()

    @contextmanager
    def patient(self) -> Iterator[None]:
        """Within this, what was not answered as it should be is requested again, some times."""
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
        self._give_way(command)
        self._in_step = False
        for line in self._splitter.feed(self._line.read(0.0)):
            self._note_hits(line)
            if self._speaks_twice(line):
                raise BadReply(f"said {_shown(line)}, which was not requested", device=self._device)
        begun = self._splitter.clear()
        self._note_hits(begun)
        if without_hits(begun):
            raise BadReply(f"was in the middle of saying {_shown(begun)}", device=self._device)
        self._lines.clear()
        with self._order:
            self._give_way(command)
            written = self._written(command)
            self._line.write(f"{written} ".encode())
        answer = self._next_answer(written, self._clock.now_s() + patience_s, skip=False)
        if self._manners.echo and not answer.echo:
            raise BadReply(f"answered {command} without its echo", device=self._device)
        if self._manners.exact and not answer.exact:
            raise BadReply(f"answered another {command} than this one", device=self._device)
        self._in_step = True
        if not answer.good:
            raise Refused(f"refuses {command}: {answer.text or 'without a reason'}", device=self._device)
        return answer.text

    def _give_way(self, command: str) -> None:
        """Raise StopCameFirst if something was sent at once; what makes a unit ready goes through with it."""
        if self._unanswered and self.gives_way and self._tries == 1:
            self._in_step = True
            raise StopCameFirst(f"a stop came before {command} was sent", device=self._device)

    def _speaks_twice(self, line: bytes) -> bool:
        """Whether an unrequested line puts the last answer in doubt: it may be the true one."""
        rest = without_hits(line)
        if rest in (b"", self._answered) or (rest == b"*" and hits_of(line)):  # once more; the end of a reset
            return False
        last = answer_of(line, self._last_written)
        return not self._manners.exact or (last is not None and (last.exact or not last.echo))

    def _written(self, command: str) -> str:
        """A command as it is written this time, which is not as the last time.

        Two small letters in front would hide a limit hit before the echo: see `protocol`.
        """
        self._turn += 1
        ways = 3 if command[1:2].isalpha() else 2
        small = {1: 0, 2: 1}.get(self._turn % ways)
        if small is not None:
            command = command[:small] + command[small].lower() + command[small + 1 :]
        self._last_written = command
        return command

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
        while (written := self._written(query.letters)).isupper():
            pass  # that would not tell whether the echo keeps small letters
        self._line.write(f"{written} ".encode())
        until_s = self._clock.now_s() + self.reply_s
        refusal = ""
        while True:
            try:
                answer = self._next_answer(written, until_s, skip=True)
            except NoReply:
                if refusal:
                    message = f"does not report its {axis} resolution: {refusal}"
                    raise Refused(message, device=self._device) from None
                raise
            other = {"pan": "tilt", "tilt": "pan"}[axis]
            number = number_of(answer.text, query.terms, " " in answer.text) if answer.good else None
            if other in answer.text.lower().split():
                number = None
            if self._manners.exact and answer.echo and not answer.exact:
                continue  # the answer to an earlier one
            if number is not None:
                return number, _Manners(" " in answer.text, answer.echo, answer.exact)
            if not answer.good:
                refusal = answer.text

    def _next_answer(self, command: str, until_s: float, skip: bool) -> PtuAnswer:
        """The next answer; a line that is none is an error unless such lines are to be skipped."""
        echo = exact = False
        last, self._answered = self._answered, b""
        while True:
            line = self._next_line(command, until_s)
            if self._manners.exact and without_hits(line) == last:
                continue  # the last answer once more: this one is written otherwise
            answer = answer_of(line, command)
            if answer is not None:
                self._answered = without_hits(line) if answer.exact else b""
                return replace(answer, echo=answer.echo or echo, exact=answer.exact or exact)
            if without_hits(line).upper() == command.upper().encode("ascii"):
                echo = True  # on a line of its own, as the E series has it
                exact = without_hits(line) == command.encode("ascii")
            elif not skip and without_hits(line):
                raise BadReply(f"answered {command.upper()} with {_shown(line)}", device=self._device)

    def _next_line(self, command: str, until_s: float) -> bytes:
        """The next complete line."""
        while not self._lines:
            data = self._line.read(max(0.0, until_s - self._clock.now_s()))
            for line in self._splitter.feed(data):
                self._note_hits(line)
                self._lines.append(line)
            if not self._lines and self._clock.now_s() >= until_s:
                raise NoReply(f"did not answer {command.upper()} within its deadline", device=self._device)
        return self._lines.popleft()

    def _quiet(self) -> None:
        """Throw away what comes until nothing has come for a while; limit hits are noted."""
        self._in_step = False
        self._answered = b""
        self._unanswered = 0
        unknown = self._manners.exact is None
        quiet_s = QUIET_S if unknown or self._manners.exact else max(QUIET_S, self.reply_s)
        until_s = self._clock.now_s() + quiet_s + LONGEST_DRAIN_S
        while self._clock.now_s() < until_s:
            data = self._line.read(quiet_s)
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
