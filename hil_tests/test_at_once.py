"""`tools/test_at_once`: several runs of the suite beside each other, each told, and nothing left of them."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest


def at_once(repository: Path, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [repository / "tools" / "test_at_once", *words],
        env={**os.environ, "TMPDIR": str(folder)}, capture_output=True, text=True,
    )  # fmt: skip


@pytest.mark.parametrize("words", [(), ("0",), ("three",), ("-h",)])
def test_a_number_of_runs_is_asked_for(repository: Path, tmp_path: Path, words: tuple[str, ...]) -> None:
    ended = at_once(repository, tmp_path, *words)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr.startswith("usage: tools/test_at_once RUNS") and not [*tmp_path.iterdir()]


@pytest.mark.long(2, "runs pytest in workers, three times")
def test_each_run_is_told_and_a_choice_of_no_test_is_none(repository: Path, tmp_path: Path) -> None:
    good = at_once(repository, tmp_path, "2", "hil_tests/calib/geometry/test_stereo.py")
    if "packages util-linux" in good.stderr:
        pytest.skip(good.stderr)
    assert good.returncode == 0, good.stderr
    assert [line[:6] for line in good.stdout.splitlines() if " passed in " in line] == ["run 1:", "run 2:"]
    assert not [*tmp_path.iterdir()]
    none = at_once(repository, tmp_path, "2", "hil_tests/calib/geometry/test_stereo.py", "-k", "no_such")
    assert none.returncode == 5 and "no tests collected" in none.stderr
