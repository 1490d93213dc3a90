"""A check of a rig, and the outcomes of many as a report in JSON."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from drivers.errors import DriverError
from mastctl.client import ClientError

State = Literal["passed", "failed", "skipped"]


class PromiseBroken(AssertionError):
    """What was promised does not hold; the message says what was found and what would be right."""


class NotTried(Exception):
    """The check does not apply to this device or daemon, or could not tell; the message says why."""


class SubjectLost(Exception):
    """What is tested does not answer any more: the checks that would follow cannot be tried."""


@dataclass(frozen=True)
class Check:
    """One promise and the function that tests it.

    Attributes
    ----------
    name
        ``group.name``, as reports and ``--only`` have it.
    promise
        One sentence: what has to hold.
    moves
        Whether the head moves for it, or would if the promise were broken.
    test
        Returns what was measured, in a few words. Raises PromiseBroken, NotTried.
    """

    name: str
    promise: str
    moves: bool
    test: Callable[[Any], str | None]


@dataclass(frozen=True)
class CheckOutcome:
    """The outcome of a check; ``message`` says what was measured, what is wrong, or why it was skipped."""

    name: str
    promise: str
    state: State
    message: str
    duration_s: float


def expect(holds: object, message: str) -> None:
    """Raise PromiseBroken unless something holds."""
    if not holds:
        raise PromiseBroken(message)


def run_checks(
    checks: Iterable[Check],
    rig: Any,
    *,
    motion: bool,
    report: Callable[[CheckOutcome], object] = lambda outcome: None,
) -> list[CheckOutcome]:
    """Run checks one after the other; return their outcomes.

    Parameters
    ----------
    checks, rig
        The checks, and the rig that they test.
    motion
        Whether the head may move; without it, checks that move it are skipped.
    report
        Called with each outcome as it comes.
    """
    outcomes: list[CheckOutcome] = []
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
                state, message = _outcome(check, rig)
            except SubjectLost as reason:
                state, message, lost = "failed", str(reason), check.name
        outcomes.append(CheckOutcome(check.name, check.promise, state, message, time.monotonic() - began_s))
        report(outcomes[-1])
    return outcomes


def _outcome(check: Check, rig: Any) -> tuple[State, str]:
    """Run one check; return its state and a sentence. Raises SubjectLost."""
    try:
        return "passed", check.test(rig) or ""
    except PromiseBroken as broken:
        return "failed", str(broken)
    except NotTried as reason:
        return "skipped", str(reason)
    except SubjectLost:
        raise
    except ClientError as error:
        if error.code == "no_daemon":
            raise SubjectLost(str(error)) from None
        return "failed", str(error)
    except DriverError as error:
        return "failed", str(error)
    except Exception as error:  # a daemon of another version may answer anything
        return "failed", f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"


@dataclass(frozen=True)
class ConformReport:
    """The outcomes of the checks of one rig.

    Attributes
    ----------
    subject
        The daemon's address.
    may_move
        Why the head may still move after all, one sentence; empty when it was stopped, or never moved.
    """

    subject: str
    outcomes: Sequence[CheckOutcome]
    may_move: str = ""

    @property
    def conforms(self) -> bool:
        """Whether no check failed, one at least passed, and the head is at rest."""
        counts = self.counts
        return counts["failed"] == 0 and counts["passed"] > 0 and not self.may_move

    @property
    def counts(self) -> dict[str, int]:
        """How many passed, failed and were skipped."""
        counted = Counter(outcome.state for outcome in self.outcomes)
        return {"passed": counted["passed"], "failed": counted["failed"], "skipped": counted["skipped"]}

    def as_json(self) -> dict[str, Any]:
        """Return it as JSON."""
        return {
            "kind": "daemon",
            "subject": self.subject,
            "conforms": self.conforms,
            **self.counts,
            "may_move": self.may_move,
            "duration_s": sum(outcome.duration_s for outcome in self.outcomes),
            "checks": [asdict(outcome) for outcome in self.outcomes],
        }
