"""Every error has a word of its own and a status by its family, and docs/reference/http.md lists both."""

from __future__ import annotations

import importlib
import pkgutil
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import drivers
import mastctl
from drivers.errors import DriverError
from mastctl.errors import (
    BadRequest,
    MastctlError,
    NoLonger,
    NotAllowed,
    NotKnown,
    NotLetIn,
    NotNow,
    Unable,
)
from mastctl.http.refusals import status_of
from mastctl.motion.requests import PointingError
from tools.page_tables import page_text

KINDS = (BadRequest, NotAllowed, NotKnown, NotLetIn, NoLonger, NotNow, Unable)
FAMILIES = {kind.__name__: kind for kind in KINDS}
NO_ANSWER = {
    "survey_refused", "cannot_tell", "address_in_use", "state_in_use",
    "token_refused", "no_executor", "task_failed", "other_program", "bad_rig", "in_the_way",
    "not_there", "look_ended",
    "report_not_written",
}  # fmt: skip
"""Of commands that ask no daemon."""


NEEDS_ROS = "mastctl.ros2."  # modules that import rclpy, which is not installed everywhere


def below(kind: type[Exception]) -> Iterator[type[Exception]]:
    for one in kind.__subclasses__():
        yield one
        yield from below(one)


@pytest.fixture(scope="module", autouse=True)
def _every_module() -> None:
    for package in (mastctl, drivers):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not module.name.endswith("__main__") and not module.name.startswith(NEEDS_ROS):
                importlib.import_module(module.name)


@pytest.fixture(scope="module")
def documented(repository: Path) -> dict[str, set[str]]:
    """The table's codes by its first column."""
    page = page_text(repository / "docs" / "reference" / "http.md")
    section = page.split("## Refusals", 1)[1].split("\n## ", 1)[0]
    rows = re.findall(r"^\| (\w[^|]*?) \| ([^|]*`[^|]*) \|", section, re.MULTILINE)
    return {status: set(re.findall(r"`(\w+)`", codes)) for status, codes in rows}


def test_each_error_class_has_a_code_of_the_table(
    documented: dict[str, set[str]],
) -> None:
    known = {code for codes in documented.values() for code in codes}
    for kind in below(DriverError):
        if kind.__module__.startswith("drivers."):
            assert "code" in vars(kind), f"{kind.__name__} has no code of its own"
            made: Any = kind("")
            assert made.code in documented[str(status_of(made))], kind.__name__
    for kind in below(MastctlError):
        if kind.__module__.startswith("mastctl.") and not issubclass(kind, tuple(FAMILIES.values())):
            told = vars(kind).get("code") or kind.__name__ in ("_Family", PointingError.__name__)
            assert told, f"{kind.__name__} has neither a family nor a code of its own"
            assert told is True or told in known | NO_ANSWER, kind.__name__
