"""Campaigns of tools/: one process and two print the same."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


def run(repository: Path, *words: str) -> str:
    """What a campaign prints on stdout, but for times."""
    command = [sys.executable, "-m", *words]
    done = subprocess.run(command, cwd=repository, capture_output=True, text=True, timeout=300, check=True)
    return "\n".join(line for line in done.stdout.splitlines() if "µs" not in line)


@pytest.mark.long(2, "two processes; test_tasks.py compares them with a cluster in the quick run")
def test_a_campaign_prints_the_same_of_one_process_and_of_two(repository: Path) -> None:
    campaign = ("tools.campaigns.handoff", "--cases", "2", "--good", "1")
    assert run(repository, *campaign, "--workers", "2") == run(repository, *campaign, "--workers", "1")
