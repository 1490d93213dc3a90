"""Shell completion, asked of a real shell."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from mastctl.cli.main import main

ASK = """source "$1"
COMP_WORDS=(mastctl {words}) COMP_CWORD={number}
_shtab_mastctl
echo "${{COMPREPLY[@]}}"
"""


@pytest.mark.parametrize(
    ("words", "expected"), [("exp", "experiment"), ("sna", "snapshot"), ("point --tim", "--timeout")]
)
def test_a_shell_completes_commands_and_options(
    words: str, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["completion", "bash"]) == 0
    (tmp_path / "completion").write_text(capsys.readouterr().out)
    script = ASK.format(words=words, number=len(words.split()))
    asked = subprocess.run(
        ["bash", "-c", script, "bash", str(tmp_path / "completion")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert asked.stdout.split() == [expected]


def test_without_the_library_it_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main(["completion", "bash"]) == 1
    assert "mastctl[completion]" in capsys.readouterr().err
