"""A check, a suite of them, and what became of each, as JSON and as a JUnit file."""

from __future__ import annotations

import time
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

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
class CheckOutcome:
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
    tell: Callable[[CheckOutcome], object] = lambda outcome: None,
) -> list[CheckOutcome]:
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
                state, message = _asked(check, subject)
            except SubjectLost as reason:
                state, message, lost = "failed", str(reason), check.name
        outcomes.append(CheckOutcome(check.name, check.promise, state, message, time.monotonic() - began_s))
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
    except ClientError as error:
        if error.code == "no_daemon":
            raise SubjectLost(str(error)) from None
        return "failed", str(error)
    except DriverError as error:
        return "failed", str(error)
    except Exception as error:  # a foreign driver may raise anything, and a foreign daemon answer anything
        return "failed", f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"


@dataclass(frozen=True)
class ConformReport:
    """What became of the checks of one subject.

    Attributes
    ----------
    kind, subject
        ``daemon``, ``head`` or ``camera``; its address, or its driver.
    began_s
        When, seconds since 1970.
    may_move
        Why the head may still move after all, one sentence; empty when it was stopped, or never moved.
    """

    kind: str
    subject: str
    began_s: float
    outcomes: Sequence[CheckOutcome]
    may_move: str = ""

    @property
    def conforms(self) -> bool:
        """Whether no check failed, one at least was passed, and the head stands."""
        counts = self.counts
        return counts["failed"] == 0 and counts["passed"] > 0 and not self.may_move

    @property
    def counts(self) -> dict[str, int]:
        """How many passed, failed and were skipped."""
        counted = Counter(outcome.state for outcome in self.outcomes)
        return {"passed": counted["passed"], "failed": counted["failed"], "skipped": counted["skipped"]}

    def told(self) -> dict[str, Any]:
        """Return it as JSON."""
        return {
            "kind": self.kind,
            "subject": self.subject,
            "conforms": self.conforms,
            **self.counts,
            "may_move": self.may_move,
            "duration_s": sum(outcome.duration_s for outcome in self.outcomes),
            "checks": [asdict(outcome) for outcome in self.outcomes],
        }

    def write_junit(self, path: Path) -> None:
        """Write it as JUnit XML, a testcase a check. Raises OSError."""
        counts = self.counts
        told = {
            "name": f"mastctl conform {self.kind}",
            "tests": str(len(self.outcomes)),
            "failures": str(counts["failed"]),
            "errors": "0",
            "skipped": str(counts["skipped"]),
            "time": f"{sum(outcome.duration_s for outcome in self.outcomes):.3f}",
        }
        suites = ET.Element("testsuites", {k: v for k, v in told.items() if k != "skipped"})
        stamp = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(self.began_s))
        suite = ET.SubElement(suites, "testsuite", {**told, "timestamp": stamp})
        listed = ET.SubElement(suite, "properties")
        ET.SubElement(listed, "property", {"name": "subject", "value": _clean(self.subject)})
        for outcome in self.outcomes:
            room, _, name = outcome.name.partition(".")
            case = ET.SubElement(
                suite,
                "testcase",
                {
                    "classname": f"mastctl.conform.{self.kind}.{room}",
                    "name": f"{name}: {outcome.promise}",
                    "time": f"{outcome.duration_s:.3f}",
                },
            )
            if outcome.state == "failed":
                ET.SubElement(case, "failure", {"message": _clean(outcome.message)}).text = _clean(
                    f"{outcome.promise}: {outcome.message}"
                )
            elif outcome.state == "skipped":
                ET.SubElement(case, "skipped", {"message": _clean(outcome.message)})
            elif outcome.message:
                ET.SubElement(case, "system-out").text = _clean(outcome.message)
        ET.indent(suites)
        ET.ElementTree(suites).write(path, encoding="utf-8", xml_declaration=True)


def _clean(text: str) -> str:
    """The text without what XML cannot hold."""
    return "".join(c if c.isprintable() else " " for c in text)
