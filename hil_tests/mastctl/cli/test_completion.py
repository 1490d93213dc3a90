"""Shell completion, by a real shell."""

from __future__ import annotations

import subprocess
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
    assert main(["--print-completion", "bash"]) == 0
    (tmp_path / "completion").write_text(capsys.readouterr().out)
    script = ASK.format(words=words, number=len(words.split()))
    asked = subprocess.run(
        ["bash", "-c", script, "bash", str(tmp_path / "completion")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert asked.stdout.split() == [expected]
