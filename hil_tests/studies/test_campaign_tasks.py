"""Campaigns of tools/: one process and two tell the same, and kept results are not worked out again."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from hil_tests.mastctl.calibration.survey_world import RIG_FILE


def run(repository: Path, *words: str) -> tuple[str, str]:
    """What a campaign says on stdout, but for times, and on stderr."""
    command = [sys.executable, "-m", *words]
    done = subprocess.run(command, cwd=repository, capture_output=True, text=True, timeout=300, check=True)
    return "\n".join(line for line in done.stdout.splitlines() if "µs" not in line), done.stderr


@pytest.mark.long(2, "three processes; test_dask.py compares tasks with a cluster in the quick run")
def test_a_campaign_tells_the_same_of_one_process_two_and_kept_results(
    repository: Path, tmp_path: Path
) -> None:
    campaign = ("tools.campaigns.refine", "--rig", str(RIG_FILE), "--cases", "1", "--handoffs", "8")
    kept = ("--results", str(tmp_path / "kept"))
    two = run(repository, *campaign, *kept, "--workers", "2")[0]
    assert two == run(repository, *campaign, "--workers", "1")[0]
    assert len(list((tmp_path / "kept").glob("*.task"))) == 4
    assert two == run(repository, *campaign, *kept)[0]
