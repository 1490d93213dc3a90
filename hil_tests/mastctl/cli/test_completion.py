"""Shell completion, asked of a real shell; and the man pages."""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
from pathlib import Path

import pytest

from mastctl.cli.main import build_parser, main
from mastctl.cli.man import man_pages

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


REQUESTS = {".TH", ".SH", ".PP", ".TP", ".nh", ".hy", ".BR"}


def commands_below(parser: argparse.ArgumentParser) -> list[argparse.ArgumentParser]:
    """A parser and those of its commands, all the way down."""
    found = [parser]
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            found += [inner for one in action.choices.values() for inner in commands_below(one)]
    return found


def test_the_man_pages_have_every_command_and_option_and_nothing_that_man_does_not_read() -> None:
    parser = build_parser([])
    pages = man_pages(parser)
    text = "".join(pages.values())
    for one in commands_below(parser):
        assert one.prog.replace("-", r"\-") in text
        for option in (name for action in one._actions for name in action.option_strings):
            assert option.replace("-", r"\-") in text
    for name, page in pages.items():
        begun = {line.split(" ")[0] for line in page.splitlines() if line.startswith((".", "'"))}
        assert begun <= REQUESTS, name
        assert page.startswith(".TH ") and page.count(".SH NAME") == 1
        assert not re.search(r"\\(?![-e&f])", page), f"{name}: a backslash that man would read"


def test_man_writes_the_pages(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["man", "--to", str(tmp_path / "man1")]) == 0
    assert f"try: man {tmp_path / 'man1' / 'mastctl-point.1'}" in capsys.readouterr().out
    assert (tmp_path / "man1" / "mastctl-point.1").read_text().startswith(".TH MASTCTL-POINT 1")
    assert (tmp_path / "man1" / "mastctl-calibrate-bench.1").is_file()


def test_man_refuses_a_file_where_a_folder_belongs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "notes").write_text("mine")
    assert main(["man", "--to", str(tmp_path / "notes")]) == 2
    assert f"{tmp_path / 'notes'} is a file; a folder is expected" in capsys.readouterr().err
    assert (tmp_path / "notes").read_text() == "mine"
