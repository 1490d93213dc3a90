"""The sampler of mutants: its changes are small, real and put back; the tests it picks are the near ones."""

from __future__ import annotations

import ast
from pathlib import Path

from tools.mutants.nearest import imports, nearest
from tools.mutants.sites import sites

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


def test_the_nearest_tests_of_a_module_are_those_that_import_it(repository: Path) -> None:
    graph = imports(repository)
    file = str(next((repository / "calib").rglob("quartic.py")).relative_to(repository))
    near = nearest(repository, graph, file, 8)
    assert len(near) == 8
    assert Path(near[0]).name == "test_quartic.py"
    assert "test_pointing.py" in {Path(test).name for test in near[:4]}
