"""Campaigns of tools/: the same words from one process and two, kept results, one task alone."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hil_tests.mastctl.calibration.survey_world import RIG_FILE
from tools.campaigns import (
    dots,
    handoff,
    keep_out,
    life,
    match_sigma,
    motion,
    pointing,
    refine,
    render_bias,
    residuals,
)
from tools.campaigns.motion import Tally, together


def run(repository: Path, *words: str) -> tuple[str, str]:
    """What a campaign says on stdout, but for times, and on stderr."""
    command = [sys.executable, "-m", *words]
    done = subprocess.run(command, cwd=repository, capture_output=True, text=True, timeout=300, check=True)
    return "\n".join(line for line in done.stdout.splitlines() if "µs" not in line), done.stderr


@pytest.mark.long(2, "five processes; test_dask.py compares tasks with a cluster in the quick run")
def test_a_campaign_tells_the_same_of_one_process_two_and_its_tasks_one_by_one(
    repository: Path, tmp_path: Path
) -> None:
    campaign = ("tools.campaigns.pointing", "--cases", "1200", "--seed", "3")
    kept = ("--results", str(tmp_path / "kept"))
    listed = run(repository, *campaign, *kept, "--list-tasks")[0].splitlines()
    assert [line.split("  ", 1)[1] for line in listed] == [
        "to do  cases from 0",
        "to do  cases from 1000",
    ]
    _, said = run(repository, *campaign, *kept, "--task", listed[1].split()[0])
    assert f"(cases from 1000) is kept in {tmp_path / 'kept'}" in said.replace("\n", " ")
    two = run(repository, *campaign, *kept, "--workers", "2")[0]
    assert two.startswith("1200 cases, seed 3: 0 failed")
    assert two == run(repository, *campaign, "--workers", "1")[0]
    assert "  done  " in run(repository, *campaign, *kept, "--list-tasks")[0]


@pytest.mark.parametrize(
    ("campaign", "words", "count"),
    [
        (pointing, ["--cases", "2500"], 3),
        (handoff, ["--cases", "100", "--good", "30"], 5 + 2),
        (motion, ["--cases", "4"], 4),
        (dots, ["--cases", "2"], 8 * 4),
        (refine, ["--rig", str(RIG_FILE), "--cases", "25"], 4 * 3),
        (render_bias, ["--samples", "1", "2", "--ranges", "3"], 2 * 5 * 2),
        (life, ["head"], 5),
        (life, ["cameras"], 9),
        (keep_out, ["--cases", "7"], 7),
        (residuals, ["--cases", "12"], 2 * 2 * 2),
        (match_sigma, ["--cases", "2", "--seeds", "2", "--relief", "0", "0.3", "0.6"], 2 * 2 * 3),
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


def test_walks_are_added_up() -> None:
    first, second = Tally(), Tally()
    first.verdicts["seen"], second.verdicts["seen"], second.verdicts["contradicted"] = 2, 1, 1
    first.off_rad, second.off_rad = [0.001], [0.002, 0.003]
    second.missed = 1
    total = together([{"navcam": {"honest": first}}, {"navcam": {"honest": second}}])["navcam"]["honest"]
    assert total.verdicts == {"seen": 3, "contradicted": 1}
    assert total.off_rad == [0.001, 0.002, 0.003] and total.missed == 1
    assert first.off_rad == [0.001], "what was given stays as it is"


def test_blocks_of_cases_have_draws_of_their_own() -> None:
    first, second = (pointing.run_block(pointing.MastBlock(1, start, 1))[0].case for start in (0, 1000))
    assert not np.allclose(first.pixel_px, second.pixel_px)
