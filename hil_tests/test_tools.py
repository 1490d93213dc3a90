"""The tools' arguments: what makes no sense, or is not there, is one sentence and exit code 2; and Ctrl-C."""

from __future__ import annotations

import runpy
import sys

import pytest

from tools.command import end

CASES = {
    "campaigns.refine --rig /nosuch": "/nosuch: cannot be read: No such file or directory",
    "campaigns.refine --rig /nosuch --click-px 0": "--click-px: '0' where a number above zero is expected",
    "against_others.trackers --work /dev/null/x": "/dev/null/x: Not a directory",
    "campaigns.handoff --cases 0": "--cases: '0' where a whole number of at least 1 is expected",
    "campaigns.handoff --out /dev/null/x.csv": "--out: /dev/null/x.csv: Not a directory",
    "campaigns.life head --minutes 0": "--minutes: '0' where a number above zero is expected",
    "campaigns.motion --moves 0": "--moves: '0' where a whole number of at least 1 is expected",
    "campaigns.provoked_surveys --cases 0": "--cases: '0' where a whole number of at least 1 is expected",
    "campaigns.provoked_surveys --pairs eye": "has no stereo pair 'eye'",
    "campaigns.soak --minutes 0": "--minutes: '0' where a number above zero is expected",
    "benchmarks.load --rounds 0": "--rounds: '0' where a whole number of at least 1 is expected",
    "campaigns.coverage --joint-sigma-rad -1": "--joint-sigma-rad: '-1' where zero or more is expected",
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
