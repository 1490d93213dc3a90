"""Campaigns of tools/: the same words from one process and two, kept results, one task alone."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from hil_tests.mastctl.calibration.survey_world import RIG_FILE
from tools.campaigns import detection, handoff, refine, residuals, sweep


def run(repository: Path, *words: str) -> tuple[str, str]:
    """What a campaign says on stdout, but for times, and on stderr."""
    command = [sys.executable, "-m", *words]
    done = subprocess.run(command, cwd=repository, capture_output=True, text=True, timeout=300, check=True)
    return "\n".join(line for line in done.stdout.splitlines() if "µs" not in line), done.stderr


@pytest.mark.long(2, "five processes; test_dask.py compares tasks with a cluster in the quick run")
def test_a_campaign_tells_the_same_of_one_process_two_and_its_tasks_one_by_one(
    repository: Path, tmp_path: Path
) -> None:
    campaign = ("tools.campaigns.refine", "--rig", str(RIG_FILE), "--cases", "1", "--handoffs", "8")
    kept = ("--results", str(tmp_path / "kept"))
    listed = run(repository, *campaign, *kept, "--list-tasks")[0].splitlines()
    assert [line.split("  ", 1)[1] for line in listed] == [
        f"to do  {where}, {moved}, cases from 0"
        for where in ("2 m", "1.5 to 4 m")
        for moved in ("moved", "not moved")
    ]
    _, said = run(repository, *campaign, *kept, "--task", listed[1].split()[0])
    assert f"(2 m, not moved, cases from 0) is kept in {tmp_path / 'kept'}" in said.replace("\n", " ")
    two = run(repository, *campaign, *kept, "--workers", "2")[0]
    assert two == run(repository, *campaign, "--workers", "1")[0]
    assert "  done  " in run(repository, *campaign, *kept, "--list-tasks")[0]


@pytest.mark.parametrize(
    ("campaign", "words", "count"),
    [
        (handoff, ["--cases", "100", "--good", "30"], 5 + 2),
        (detection, ["--cases", "2", "--kind", "dots"], 5 * 2),
        (refine, ["--rig", str(RIG_FILE), "--cases", "25"], 4 * 3),
        (sweep, ["joints", "--cases", "2"], 4 * 3 * 2),
        (residuals, ["--cases", "12"], 2 * 2 * 2),
    ],
)
def test_what_is_a_task_of_a_campaign(
    campaign: object,
    words: list[str],
    count: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["campaign", *words, "--list-tasks"])
    with pytest.raises(SystemExit, match=r"^0$"):
        campaign.main()  # type: ignore[attr-defined]
    names = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert len(names) == len(set(names)) == count
