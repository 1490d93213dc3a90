"""The commands of tokens: one is shown once, the list shows none, and wrong use is one line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mastctl.cli.main import main
from mastctl.http.tokens import TokenList


def test_a_token_is_made_listed_and_revoked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    there = ["--state", str(tmp_path)]
    assert main(["token", "new", "--name", "wall", "--role", "view", *there]) == 0
    text = capsys.readouterr().out.strip()
    assert len(text) == 43
    assert main(["token", "list", "--json", *there]) == 0
    shown = capsys.readouterr().out
    assert [one["name"] for one in json.loads(shown)["tokens"]] == ["wall"]
    held = TokenList(tmp_path).read()
    assert held is not None and text not in shown and held[0].sha256 not in shown
    assert main(["token", "revoke", "wall", *there]) == 0
    assert TokenList(tmp_path).read() == ()


def test_what_cannot_be_is_one_line_and_the_code_of_wrong_use(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["token", "revoke", "nobody", "--state", str(tmp_path)]) == 2
    assert "there is no token 'nobody'" in capsys.readouterr().err
    assert main(["token", "list", "--state", str(tmp_path / "nowhere"), "--json"]) == 0
    assert main(["token", "new", "--name", "a", "--role", "root", "--state", str(tmp_path)]) == 2
    assert main(["run", "--listen", "8420"]) == 2
    assert "HOST:PORT" in capsys.readouterr().err
