"""The sampler of mutants: its changes are small, real and put back; the tests it picks are the near ones."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from mastctl import signals
from tools.mutants.sites import imports, nearest, sites
from tools.mutants.trial import run, run_change

MODULE = '''"""Words."""
import logging

log = logging.getLogger(__name__)
LIMIT_M = 3


def reach(a: int | None, b: float) -> float:
    """Words."""
    if a is None and b > 2:
        log.info("not watched %d", 7)
        raise ValueError(f"neither is {b + 1}")
    show(a)
    return -a * b
'''


def changes(tmp_path: Path) -> dict[str, set[str]]:
    (tmp_path / "module.py").write_text(MODULE)
    found: dict[str, set[str]] = {}
    for site in sites(tmp_path, "module.py"):
        changed = site.applied(MODULE)
        ast.parse(changed)
        (differs,) = [
            new for old, new in zip(MODULE.splitlines(), changed.splitlines(), strict=True) if old != new
        ]
        found.setdefault(site.kind, set()).add(differs.strip())
    return found


def test_each_change_is_one_line_that_still_parses(tmp_path: Path) -> None:
    assert changes(tmp_path) == {
        "number": {"LIMIT_M = 4", "if a is None and b > 3:"},
        "comparison": {"if (a is not None) and b > 2:", "if a is None and (b >= 2):"},
        "and, or": {"if (a is None or b > 2):"},
        "condition": {"if (not (a is None and b > 2)):"},
        "call dropped": {"pass"},
        "operator": {"return (-a / b)"},
        "sign": {"return (a) * b"},
    }


def test_a_change_is_told_with_its_place_and_both_texts(tmp_path: Path) -> None:
    (tmp_path / "module.py").write_text(MODULE)
    (sign,) = [site for site in sites(tmp_path, "module.py") if site.kind == "sign"]
    assert sign.told(MODULE) == "module.py:14  sign: -a  ->  (a)"


def test_what_never_runs_is_not_changed(tmp_path: Path) -> None:
    (tmp_path / "module.py").write_text(
        """class Head(Protocol):
    def read(self, tries: int = 3) -> float: ...

class Limit:
    def __repr__(self) -> str:
        return shown(self.low + 1)

if __name__ == "__main__":
    end(main)
"""
    )
    assert sites(tmp_path, "module.py") == []


OFTEN = pytest.mark.long(
    3, "runs pytest in a process of its own three to five times; once is in the quick run"
)
CODE = "def doubled(a):\n    return a * 2\n\n\ndef unused(a):\n    while a:\n        a -= 1\n"


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    copy = tmp_path / "0" / "checkout"
    (copy / "calib").mkdir(parents=True)
    (copy / "calib" / "__init__.py").write_text("")
    (copy / "calib" / "code.py").write_text(CODE)
    (copy / "pyproject.toml").write_text("[tool.pytest.ini_options]\n")
    (copy / "test_code.py").write_text(
        "from calib.code import doubled\n\n\ndef test_two():\n    assert doubled(2) == 4\n"
    )
    return copy


def test_a_run_says_who_objected(checkout: Path) -> None:
    assert run(checkout, ["test_code.py"], 30.0, 120.0).outcome == "passed"
    (checkout / "calib" / "code.py").write_text(CODE.replace("* 2", "* 3"))
    killed = run(checkout, ["test_code.py"], 30.0, 120.0)
    assert (killed.outcome, killed.test) == ("killed", "test_code.py::test_two")


def test_tests_run_in_a_process_that_looks_like_pytests_own(checkout: Path) -> None:
    (checkout / "test_code.py").write_text(
        "import sys\n\n\ndef test_it():\n    assert sys.modules['__main__'].__spec__.name == 'pytest'\n"
    )
    assert run(checkout, ["test_code.py"], 30.0, 120.0).outcome == "passed"


@OFTEN
@pytest.mark.parametrize(
    ("code", "outcome"),
    [
        ("def doubled(a):\n    while True:\n        a += 1\n", "killed by timeout"),
        ("import nothing_of_the_kind\n", "broken"),
    ],
)
def test_neither_an_endless_loop_nor_a_module_that_cannot_be_imported_is_a_test_that_objects(
    checkout: Path, code: str, outcome: str
) -> None:
    (checkout / "calib" / "code.py").write_text(code)
    with signals.raised():  # as in the tool
        assert run(checkout, ["test_code.py"], 1.0, 120.0).outcome == outcome


@OFTEN
def test_what_a_test_objects_to_once_or_without_the_change_too_is_no_kill(checkout: Path) -> None:
    (checkout / "test_code.py").write_text(
        """from pathlib import Path

import pytest

from calib.code import doubled


def test_once():
    ran = Path("ran")
    before = ran.exists()
    ran.touch()
    assert before


def test_busy():
    assert False


@pytest.mark.parametrize("a", [2, 3])
def test_two(a):
    assert a == 3 or doubled(a) == 4
"""
    )
    file = checkout / "calib" / "code.py"
    tests = ["test_code.py"]
    killed = run_change(file, CODE.replace("* 2", "* 3"), checkout, tests, 30.0, 120.0)
    assert (killed.outcome, killed.test) == ("killed", "test_code.py::test_two[2]")
    assert file.read_text() == CODE
    (checkout / "ran").unlink()
    assert run_change(file, CODE.replace("-= 1", "-= 2"), checkout, tests, 30.0, 120.0).outcome == "passed"


@OFTEN
def test_tests_that_are_all_skipped_object_to_nothing(checkout: Path) -> None:
    (checkout / "test_code.py").write_text(
        "import pytest\n\npytest.skip('there is no camera', allow_module_level=True)\n"
    )
    assert run(checkout, ["test_code.py"], 30.0, 120.0).outcome == "passed"


def test_the_nearest_tests_of_a_module_are_those_that_import_it(repository: Path) -> None:
    graph = imports(repository)
    file = "calib/geometry/reach.py"
    near = nearest(repository, graph, file, 8)
    assert len(near) == 8
    assert Path(near[0]).name == "test_quartic.py"
    assert "test_pointing.py" in {Path(test).name for test in near[:4]}
