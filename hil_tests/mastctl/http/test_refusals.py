"""Every error has a word of its own and a status by its family, and docs/reference/http.md lists both."""

from __future__ import annotations

import ast
import importlib
import pkgutil
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import drivers
import mastctl
from calib.errors import CalibError
from drivers.errors import BadOptions, DriverError, NoFreshFrame, NoReply
from hil_tests.mastctl.service_fakes import HTTP, FakeHardware
from mastctl.daemon import RunningDaemon
from mastctl.errors import (
    BadRequest,
    MastctlError,
    NoLonger,
    NotAllowed,
    NotKnown,
    NotLetIn,
    NotNow,
    Stopped,
    TooMany,
    Unable,
)
from mastctl.http.refusals import GuardError, error_response, status_of
from mastctl.motion.results import PointingError
from tools import error_codes

KINDS = (BadRequest, NotAllowed, NotKnown, NotLetIn, NoLonger, NotNow, TooMany, Unable)
FAMILIES = {kind.__name__: kind for kind in KINDS}
PLAIN = {GuardError.__name__, error_response.__name__}  # status first, then the code
NO_ANSWER = {
    "search_cut_short", "survey_refused", "cannot_tell", "address_in_use", "state_in_use",
    "token_refused", "no_executor", "task_failed", "other_program", "bad_rig", "in_the_way",
    "not_there", "nobody_there", "board_not_found", "board_lost", "look_ended",
    "report_not_written", "no_such_frame",
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
    page = (repository / "docs" / "reference" / "http.md").read_text(encoding="utf-8")
    section = page.split("## Refusals", 1)[1].split("\n## ", 1)[0]
    rows = re.findall(r"^\| (\w[^|]*?) \| ([^|]*`[^|]*) \|", section, re.MULTILINE)
    return {status: set(re.findall(r"`(\w+)`", codes)) for status, codes in rows}


@pytest.fixture(scope="module")
def written(repository: Path) -> dict[str, set[str]]:
    """The codes that the service's code names, by status; under ``operation`` those of a pointing."""
    codes: dict[str, set[str]] = {"operation": set()}
    package = repository / "mastctl"
    for path in sorted(package.rglob("*.py")):
        if path.is_relative_to(package / "testing"):  # told to a test, not over HTTP
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            for status, code in _named(node):
                codes.setdefault(status, set()).add(code)
    return codes


def _named(node: ast.AST) -> Iterator[tuple[str, str]]:
    """Codes given in a call of a family, in a class below one, or beside a status."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        words = [one.value for one in node.args[:2] if isinstance(one, ast.Constant)]
        if node.func.id in FAMILIES and words:
            yield str(status_of(FAMILIES[node.func.id](str(words[0]), ""))), str(words[0])
        elif node.func.id == PointingError.__name__ and words:
            yield "operation", str(words[0])
        elif node.func.id in PLAIN and len(words) == 2:
            yield str(words[0]), str(words[1])
    if isinstance(node, ast.ClassDef):
        kind = next(
            (FAMILIES[b.id] for b in node.bases if isinstance(b, ast.Name) and b.id in FAMILIES), None
        )
        for call in ast.walk(node) if kind is not None else ():
            if isinstance(call, ast.Call) and ast.unparse(call.func) == "super().__init__":
                code = ast.literal_eval(call.args[0])
                yield str(status_of(kind(code, ""))), code  # type: ignore[misc]


def test_each_code_of_the_service_stands_in_the_table_under_its_status(
    documented: dict[str, set[str]], written: dict[str, set[str]]
) -> None:
    assert len(written["409"]) > 10
    assert len(written["operation"]) > 10
    for status, codes in written.items():
        assert codes <= documented[status], status


def test_each_error_class_of_service_and_drivers_has_its_own_code_and_stands_in_the_table(
    documented: dict[str, set[str]],
) -> None:
    known = {code for codes in documented.values() for code in codes}
    for kind in below(DriverError):
        if kind.__module__.startswith("drivers."):
            assert "code" in vars(kind), f"{kind.__name__} has no code of its own"
            assert kind("").code in documented[str(status_of(kind("")))], kind.__name__
    for kind in below(MastctlError):
        if kind.__module__.startswith("mastctl.") and not issubclass(kind, tuple(FAMILIES.values())):
            told = vars(kind).get("code") or kind.__name__ in ("_Family", PointingError.__name__)
            assert told, f"{kind.__name__} has neither a family nor a code of its own"
            assert told is True or told in known | NO_ANSWER, kind.__name__


def test_the_page_of_error_codes_explains_each_code_of_the_table(documented: dict[str, set[str]]) -> None:
    explained = {code: (status, meaning) for code, status, meaning, _ in error_codes.rows()}
    for status, codes in documented.items():
        for code in codes:
            assert status in explained[code][0], code
            assert len(explained[code][1]) > 10, f"{code} has no meaning in the code"
    assert explained["no_reply"][1] == NoReply.__doc__
    assert "not_predictive" in explained, "a code of commands alone"


def test_no_code_has_two_statuses(documented: dict[str, set[str]]) -> None:
    answers = {status: codes for status, codes in documented.items() if status.isdecimal()}
    for status, codes in answers.items():
        others = set[str]().union(*(those for other, those in answers.items() if other != status))
        assert codes & others <= {"not_json"}, status  # no JSON by its name, and by its content


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (BadRequest("bad_aim", "no"), 422),
        (NotLetIn("no_token", "no"), 401),
        (NotAllowed("role", "no"), 403),
        (TooMany("too_many_guesses", "no"), 429),
        (NotKnown("unknown_camera", "no"), 404),
        (NoLonger("frame_too_old", "no"), 410),
        (Stopped("no"), 409),
        (Unable("closing", "no"), 503),
        (MastctlError("no"), 500),
        (CalibError("no"), 422),
        (BadOptions("no"), 422),
        (NoReply("no"), 504),
        (NoFreshFrame("no"), 504),
        (DriverError("no"), 502),
    ],
)
def test_a_family_answers_with_one_status(error: Exception, status: int) -> None:
    assert status_of(error) == status


def test_a_renamed_key_is_refused_with_its_new_name(
    standing: tuple[RunningDaemon, FakeHardware],
) -> None:
    for path, key, new in (("lease", "gives_way", "preemptible"), ("bench", "goes_on", "resume")):
        answer = HTTP.post(f"{standing[0].url}/api/v1/{path}", json={key: True})
        message = answer.json()["error"]["message"]
        assert (answer.status_code, message) == (422, f"{key} is called {new} since version 0.1")
