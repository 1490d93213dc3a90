"""What became of the checks, as JSON and as a JUnit file."""

from __future__ import annotations

import time
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mastctl.conform.checks import Outcome


@dataclass(frozen=True)
class Report:
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
    outcomes: Sequence[Outcome]
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
