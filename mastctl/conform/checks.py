"""A check, a suite of them, and what became of each."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

from drivers.errors import DriverError
from mastctl.client import ClientError

Subject = TypeVar("Subject")
State = Literal["passed", "failed", "skipped"]


class PromiseBroken(AssertionError):
    """What was promised does not hold; the message says what was found and what would be right."""


class NotTried(Exception):
    """The check does not apply to this device or daemon, or could not tell; the message says why."""


class SubjectLost(Exception):
    """There is nobody left to ask: the checks that would follow cannot be tried."""


@dataclass(frozen=True)
class Check(Generic[Subject]):
    """One promise and what asks for it.

    Attributes
    ----------
    name
        ``subject.what``; what reports and ``--only`` call it.
    promise
        One sentence: what has to hold.
    moves
        Whether the head moves for it, or would if the promise were broken.
    ask
        Asks; returns a few words of what was measured. Raises PromiseBroken, NotTried.
    """

    name: str
    promise: str
    moves: bool
    ask: Callable[[Subject], str | None]


@dataclass(frozen=True)
class Outcome:
    """What became of a check; ``message`` says what was measured, what is wrong, or why it was skipped."""

    name: str
    promise: str
    state: State
    message: str
    duration_s: float


class Suite(Generic[Subject]):
    """Checks in the order in which they run, entered by a decorator."""

    def __init__(self) -> None:
        self.checks: list[Check[Subject]] = []

    def check(
        self, name: str, promise: str, *, moves: bool = False
    ) -> Callable[[Callable[[Subject], str | None]], Callable[[Subject], str | None]]:
        """Enter a function as a check."""

        def enter(ask: Callable[[Subject], str | None]) -> Callable[[Subject], str | None]:
            self.checks.append(Check(name, promise, moves, ask))
            return ask

        return enter


def expect(holds: object, words: str) -> None:
    """Pass what holds. Raises PromiseBroken."""
    if not holds:
        raise PromiseBroken(words)


def run_checks(
    checks: Iterable[Check[Subject]],
    subject: Subject,
    *,
    motion: bool,
    tell: Callable[[Outcome], object] = lambda outcome: None,
) -> list[Outcome]:
    """Run checks one after the other; return what became of each.

    Parameters
    ----------
    checks, subject
        What to ask of whom.
    motion
        Whether the head may move; without it, checks that move it are skipped.
    tell
        Called with each outcome as it comes.
    """
    outcomes: list[Outcome] = []
    lost = ""
    for check in checks:
        began_s = time.monotonic()
        state: State = "skipped"
        if lost:
            message = f"not tried after {lost}"
        elif check.moves and not motion:
            message = "the head may not move"
        else:
            try:
                state, message = _asked(check, subject)
            except SubjectLost as reason:
                state, message, lost = "failed", str(reason), check.name
        outcomes.append(Outcome(check.name, check.promise, state, message, time.monotonic() - began_s))
        tell(outcomes[-1])
    return outcomes


def _asked(check: Check[Subject], subject: Subject) -> tuple[State, str]:
    """Run one check; whatever it meets is a word and a sentence, but for SubjectLost."""
    try:
        return "passed", check.ask(subject) or ""
    except PromiseBroken as broken:
        return "failed", str(broken)
    except NotTried as reason:
        return "skipped", str(reason)
    except SubjectLost:
        raise
    except (ClientError, DriverError) as error:
        return "failed", str(error)
    except Exception as error:  # a foreign driver may raise anything, and a foreign daemon answer anything
        return "failed", f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
