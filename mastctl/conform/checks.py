"""A check of a rig, and the outcomes of many as a report in JSON."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
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
    """One promise, a sentence, and the function that tests it.

    ``name`` is ``group.name``; ``moves``: whether the head moves for it, or would if the promise were broken.
    ``test`` returns a short text of what was measured, and raises PromiseBroken or NotTried.
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


def outcome_of(check: Check, rig: Any) -> CheckOutcome:
    """Run one check. Raises SubjectLost."""
    began_s = time.monotonic()
    state: State = "failed"
    try:
        state, message = "passed", check.test(rig) or ""
    except NotTried as reason:
        state, message = "skipped", str(reason)
    except SubjectLost:
        raise
    except ClientError as error:
        if error.code == "no_daemon":
            raise SubjectLost(str(error)) from None
        message = str(error)
    except (PromiseBroken, DriverError) as error:
        message = str(error)
    except Exception as error:  # a daemon of another version may answer anything
        message = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
    return CheckOutcome(check.name, check.promise, state, message, time.monotonic() - began_s)


@dataclass(frozen=True)
class ConformReport:
    """The outcomes of the checks of one rig; ``subject`` is the daemon's address.

    ``may_move`` is why the head may still move, one sentence; empty when it was stopped, or never moved.
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
