"""docs/how-to/conform.md lists every check with its promise."""

from __future__ import annotations

from pathlib import Path

from mastctl.conform.daemon_run import CHECKS
from mastctl.conform.drivers_run import ALL


def test_the_page_has_a_row_for_every_check_and_no_other(repository: Path) -> None:
    page = (repository / "docs" / "how-to" / "conform.md").read_text(encoding="utf-8")
    checks = (*CHECKS, *ALL["head"], *ALL["camera"])
    rows = [f"| `{c.name}` | {'moves' if c.moves else ''} | {c.promise} |" for c in checks]
    assert [line for line in page.splitlines() if line.startswith("| `")] == rows
