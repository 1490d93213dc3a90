"""Without the kernel the tests that need it skip, and one line at the end says how many and what mends it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tools.virtual_machine import kernel


@pytest.mark.parametrize(
    "how",
    [
        pytest.param(["-p", "no:xdist"], id="in one process"),
        pytest.param(
            *(["-n", "1"],),
            id="in several",
            marks=pytest.mark.long(2, "pytest in a worker of its own; one without is in the quick run"),
        ),
    ],
)
def test_the_last_line_before_the_counts_says_what_did_not_run(
    how: list[str], repository: Path, tmp_path: Path
) -> None:
    if reason := kernel.why_not():
        pytest.skip(reason)
    command = [sys.executable, "-m", "pytest", "hil_tests/vm/test_no_result.py", "-p", "no:cacheprovider"]
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    done = subprocess.run([*command, *how], cwd=repository, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    *_, line, counts = done.stdout.splitlines()
    assert "4 skipped" in counts
    assert line == (
        "not run: 4 tests on a kernel with virtual cameras: the kernel is not built; tools/vm setup builds it"
    )
