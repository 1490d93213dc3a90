"""Tokens on disk: made once, private, digests only; whatever is damaged is refused by name."""

from __future__ import annotations

import hashlib
import json
import stat
import threading
from pathlib import Path

import pytest

from calib.errors import BadFile
from hil_tests.waiting import joined
from mastctl.control.lease import ROLES
from mastctl.http.tokens import TokenList, TokenRefused


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.fixture
def tokens(tmp_path: Path) -> TokenList:
    tokens = TokenList(tmp_path)
    tokens.first_run()
    return tokens


def text_of(tokens: TokenList, role: str) -> str:
    return tokens.file_of(role).read_text().strip()  # type: ignore[arg-type]


def test_the_first_run_makes_a_private_256_bit_token_for_each_role(tokens: TokenList) -> None:
    texts = {role: text_of(tokens, role) for role in ROLES}
    assert len(set(texts.values())) == 3
    assert {len(text) for text in texts.values()} == {43}, "32 bytes in base64 without padding"
    assert {mode(path) for path in tokens.folder.iterdir()} == {0o600}
    held = {one.role: one.sha256 for one in tokens.read() or ()}
    assert held == {role: hashlib.sha256(text.encode()).hexdigest() for role, text in texts.items()}


def test_the_list_holds_no_token(tokens: TokenList) -> None:
    made = tokens.new("bench", "operate")
    kept = "".join(path.read_text() for path in tokens.folder.iterdir())
    assert made not in kept
    listed = tokens.path.read_text()
    assert not any(text_of(tokens, role) in listed for role in ROLES)


def test_a_revoked_token_of_a_role_is_not_made_again(tokens: TokenList) -> None:
    tokens.revoke("admin")
    assert not tokens.file_of("admin").exists()
    assert [one.name for one in tokens.first_run()] == ["view", "operate"]


@pytest.mark.parametrize("name", ["", "a/b", "x" * 41, "admin"])
def test_an_empty_bad_or_taken_name_is_refused(tokens: TokenList, name: str) -> None:
    with pytest.raises(TokenRefused):
        tokens.new(name, "view")


@pytest.mark.parametrize("name", ["tokens.json", "admin.token"])
@pytest.mark.parametrize("others", [0o640, 0o602])
def test_a_file_open_to_other_users_is_refused(tokens: TokenList, name: str, others: int) -> None:
    (tokens.folder / name).chmod(others)
    with pytest.raises(BadFile, match="chmod 600"):
        tokens.read()


ENTRY = {"name": "a", "role": "view", "sha256": "0" * 64, "made": "2026-01-01T00:00:00+00:00"}


@pytest.mark.parametrize(
    "held",
    [
        "x",
        [{**ENTRY, "role": "root"}],
        [{**ENTRY, "sha256": "0"}],
        [ENTRY, ENTRY],
    ],
)
def test_a_damaged_list_is_refused_and_stays_as_it_is(tokens: TokenList, held: object) -> None:
    tokens.path.write_text(json.dumps({"schema": "mastctl/tokens/1", "tokens": held}))
    before = tokens.path.read_bytes()
    for act in (tokens.read, tokens.first_run, lambda: tokens.new("b", "view"), lambda: tokens.revoke("a")):
        with pytest.raises(BadFile):
            act()
    assert tokens.path.read_bytes() == before


def test_commands_at_the_same_time_lose_no_token(tokens: TokenList) -> None:
    threads = [threading.Thread(target=tokens.new, args=(f"t{i}", "view")) for i in range(8)]
    for one in threads:
        one.start()
    joined(*threads)
    assert {one.name for one in tokens.read() or ()} == {*ROLES, *(f"t{i}" for i in range(8))}
