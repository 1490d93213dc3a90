"""The sizes in budgets.toml hold, and no commit raises one."""

from __future__ import annotations

import subprocess
from itertools import pairwise
from pathlib import Path

from tools.budgets import FILE, budgets, counts


def test_no_place_exceeds_its_budget(repository: Path) -> None:
    present = counts(repository)
    limits = budgets((repository / FILE).read_text())
    assert set(limits) == set(present)
    over = {
        f"{place} {unit}": f"{present[place][unit]} of {limit}"
        for place, units in limits.items()
        for unit, limit in units.items()
        if present[place][unit] > limit
    }
    assert over == {}, "delete something, or find what already does the job"


def test_a_budget_only_goes_down(repository: Path) -> None:
    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", *arguments], cwd=repository, capture_output=True, text=True, check=True
        ).stdout

    commits = git("log", "--format=%H", "--", str(FILE)).split()
    versions = [budgets(git("show", f"{commit}:{FILE}")) for commit in commits]
    versions.insert(0, budgets((repository / FILE).read_text()))
    raised = {
        f"{place} {unit} in {commit[:8]}"
        for commit, (new, old) in zip(["the checkout", *commits], pairwise(versions), strict=False)
        for place, units in new.items()
        for unit, limit in units.items()
        if limit > old.get(place, {}).get(unit, limit)
    }
    assert raised == set()
