"""docs/how-to/conform.md lists every check with its promise."""

from __future__ import annotations

from pathlib import Path

from mastctl.conform.devices import ALL
from mastctl.conform.rig_checks import RIG


def test_the_page_has_a_row_for_every_check_and_no_other(repository: Path) -> None:
    page = (repository / "docs" / "how-to" / "conform.md").read_text(encoding="utf-8")
    checks = (*RIG.checks, *ALL["head"], *ALL["camera"])
    rows = [f"| `{c.name}` | {'moves' if c.moves else ''} | {c.promise} |" for c in checks]
    assert [line for line in page.splitlines() if line.startswith("| `")] == rows
