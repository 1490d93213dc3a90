"""The tools' arguments: what makes no sense, or is not there, is one sentence and exit code 2; and Ctrl-C."""

from __future__ import annotations

import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tools.command import end

CASES = {
    "against_others.spheres /nosuch": "/nosuch/index.yaml: cannot be read: No such file or directory",
    "campaigns.handoff --cases 0": "--cases: '0' where a whole number of at least 1 is expected",
    "campaigns.provocations survey --cases 0": "--cases: '0' where a whole number of at least 1 is expected",
    "benchmarks.daemon start --rounds 0": "--rounds: '0' where a whole number of at least 1 is expected",
    "campaigns.coverage survey --gross -1": "--gross: '-1' where zero or more is expected",
}


@pytest.mark.parametrize("words", CASES)
def test_what_a_tool_cannot_use_is_one_sentence(
    words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    name, *arguments = words.split()
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(f"tools.{name}", run_name="__main__")
    assert ended.value.code == 2
    assert capsys.readouterr().err.rstrip("\n").endswith(CASES[words])


def test_an_interrupted_tool_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted() -> int:
        raise KeyboardInterrupt

    with pytest.raises(SystemExit) as ended:
        end(interrupted)
    assert ended.value.code == 130 and capsys.readouterr().err == ""


def test_the_help_of_the_demo_names_the_operator_page(repository: Path, tmp_path: Path) -> None:
    (tmp_path / "tools").mkdir()
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    demo = shutil.copy(repository / "tools" / "demo", tmp_path / "tools")
    for file, text in (("tools/setup", "exit 0"), (".venv/bin/mastctl", 'echo "mastctl $*"')):
        (tmp_path / file).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / file).chmod(0o755)
    for option in ("--help", "-h"):
        said = subprocess.run([demo, option], capture_output=True, text=True, check=True).stdout
        assert "--page" in said and f"mastctl demo {option}" in said
