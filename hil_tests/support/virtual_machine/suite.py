"""The camera tests in the machine: their outcome, or that there is none."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from hil_tests.support.virtual_machine.boot import Result, VmFailed

REPOSITORY = Path(__file__).resolve().parents[3]
TESTS = "hil_tests/vm/inside"
TAIL = 3000


@dataclass(frozen=True)
class SuiteOutcome:
    """How many tests ran, those that did not pass with the reason, and the end of the console."""

    tests: int
    bad: tuple[str, ...]
    console: str


def run_tests(boot: Callable[..., Result], out: Path, tests: Sequence[str] = (TESTS,)) -> SuiteOutcome:
    """Run tests in the machine.

    Parameters
    ----------
    boot
        ``boot(command, out, folder=..., environment=...)``, as `boot.run` with its kernel bound.
    out
        An empty folder.
    tests
        What pytest is given.

    Raises
    ------
    VmFailed
        If no result came out, or no test ran, or pytest failed beside the tests: never a pass.
    """
    command = [sys.executable, "-m", "pytest", *tests, "-q", "-p", "no:cacheprovider"]
    environment = {"PYTHONPATH": str(REPOSITORY), "OPENBLAS_NUM_THREADS": "1"}
    result = boot(
        [*command, "--junitxml=/run/out/results.xml"], out, folder=REPOSITORY, environment=environment
    )
    tail = result.console[-TAIL:]
    report = out / "results.xml"
    if not report.is_file():
        raise VmFailed(f"no results came out of the machine:\n{tail}")
    cases = list(ElementTree.parse(report).getroot().iter("testcase"))
    if not cases:
        raise VmFailed(f"no test ran in the machine:\n{tail}")
    bad = [
        f"{case.get('name')}: {child.get('message')}"
        for case in cases
        for child in case
        if child.tag in ("failure", "error", "skipped")
    ]
    if result.status != 0 and not bad:
        raise VmFailed(f"pytest ended with {result.status} in the machine:\n{tail}")
    return SuiteOutcome(len(cases), tuple(bad), tail)
