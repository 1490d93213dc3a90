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


def test_one_command_installs_it_for_a_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    assert main(["completion", "bash"]) == 0
    script = capsys.readouterr().out
    assert main(["completion", "bash", "--install"]) == 0
    assert (tmp_path / "bash-completion/completions/mastctl").read_text() == script
    assert main(["completion", "zsh", "--install"]) == 0
    assert f"fpath+=({tmp_path / 'zsh/site-functions'})" in capsys.readouterr().err
    assert main(["completion", "tcsh", "--install"]) == 2
    monkeypatch.setenv("XDG_DATA_HOME", "/proc/nowhere")
    assert main(["completion", "bash", "--install"]) == 2
    assert "/proc/nowhere/bash-completion/completions/mastctl" in capsys.readouterr().err
