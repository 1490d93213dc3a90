"""The tokens of a running daemon: as their list is now, in memory as digests, compared as a whole."""

from __future__ import annotations

from pathlib import Path

import pytest

from mastctl.answers import Role
from mastctl.errors import NotLetIn
from mastctl.http.tokens import Access, TokenList


@pytest.fixture
def tokens(tmp_path: Path) -> TokenList:
    return TokenList(tmp_path)


@pytest.fixture
def access(tokens: TokenList) -> Access:
    return Access(tokens)


def token(tokens: TokenList, role: Role = "operate") -> str:
    return tokens.file_of(role).read_text().strip()


def test_a_token_is_known_by_name_and_role_and_nothing_near_it(access: Access, tokens: TokenList) -> None:
    text = token(tokens)
    assert (access.token_of(text).name, access.token_of(text).role) == ("operate", "operate")
    for near in (text[:-1], text + "A", text.swapcase(), "", "Ω" * 43, "\udc80"):
        with pytest.raises(NotLetIn) as refused:
            access.token_of(near)
        assert refused.value.code == "wrong_token"


def test_new_lent_and_revoked_tokens_count_without_a_restart(access: Access, tokens: TokenList) -> None:
    made = tokens.new("bench", "view")
    access.reread()
    digest = access.token_of(made).sha256
    lent, take_back = access.temporary("guide")
    lent_digest = access.token_of(lent).sha256
    assert access.token_of(lent).role == "operate"
    assert access.is_valid(digest) and access.is_valid(lent_digest) and not access.is_valid("")
    tokens.revoke("bench")
    access.reread()
    take_back()
    for text in (made, lent):
        with pytest.raises(NotLetIn):
            access.token_of(text)
    assert not access.is_valid(digest) and not access.is_valid(lent_digest)


def test_a_list_damaged_or_lost_meanwhile_changes_nothing(
    access: Access, tokens: TokenList, caplog: pytest.LogCaptureFixture
) -> None:
    text = token(tokens)
    tokens.path.write_text("{")
    access.reread()
    assert access.token_of(text).role == "operate"
    assert "stay as they were" in caplog.text
    tokens.path.unlink()
    access.reread()
    assert access.token_of(text).role == "operate"
