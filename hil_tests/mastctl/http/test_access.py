"""Who is let in: tokens as they are now, sessions that end, and guessing that is not heard."""

from __future__ import annotations

import gc
import hashlib
from collections.abc import Iterator
from pathlib import Path
from types import FunctionType, ModuleType

import pytest

from drivers.clock import ManualClock
from mastctl.errors import NotLetIn, TooMany
from mastctl.http.access import (
    MOST_ADDRESSES,
    MOST_OF_ALL,
    MOST_OF_ONE,
    SESSION_S,
    SESSIONS_OF_ONE,
    WINDOW_S,
    Access,
    Guesses,
    neighbourhood,
)
from mastctl.http.tokens import TokenList, digest_of

HERE = "10.0.0.1"


@pytest.fixture
def tokens(tmp_path: Path) -> TokenList:
    return TokenList(tmp_path)


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


@pytest.fixture
def access(tokens: TokenList, clock: ManualClock) -> Iterator[Access]:
    made = Access(tokens, clock)
    yield made
    made.close()


def token(tokens: TokenList, role: str = "operate") -> str:
    return tokens.file_of(role).read_text().strip()  # type: ignore[arg-type]


def code_of(access: Access, text: str, address: str = HERE) -> str:
    """How a token is refused."""
    with pytest.raises((NotLetIn, TooMany)) as refused:
        access.token_of(text, address)
    return str(refused.value.code)


def test_a_token_is_known_by_name_and_role_and_nothing_near_it_is(access: Access, tokens: TokenList) -> None:
    text = token(tokens)
    assert (access.token_of(text, HERE).name, access.token_of(text, HERE).role) == ("operate", "operate")
    for near in (text[:-1], text + "A", text.swapcase(), "", "Ω" * 43, "\udc80"):
        assert code_of(access, near) == "wrong_token"


def test_no_token_is_kept_in_memory(access: Access, tokens: TokenList) -> None:
    text = token(tokens)
    secret = access.log_in(text, HERE)[0]
    found, left = set[int](), [vars(access)]
    words = set[str]()
    while left:
        one: object = left.pop()
        if id(one) in found or isinstance(one, (type, ModuleType, FunctionType)):
            continue
        found.add(id(one))
        if isinstance(one, str):
            words.add(one)
        left += gc.get_referents(one)  # type: ignore[arg-type]
    assert hashlib.sha256(text.encode()).hexdigest() in words, "what is held was walked through"
    assert not {text, secret} & words


def test_a_new_token_opens_and_a_revoked_one_opens_nothing_without_a_restart(
    access: Access, tokens: TokenList
) -> None:
    made = tokens.new("bench", "view")
    access.reread()
    assert access.token_of(made, HERE).name == "bench"
    tokens.revoke("bench")
    access.reread()
    assert code_of(access, made) == "wrong_token"


def test_a_list_that_is_damaged_while_the_daemon_runs_changes_nothing_and_is_told(
    access: Access, tokens: TokenList, caplog: pytest.LogCaptureFixture
) -> None:
    text = token(tokens)
    tokens.path.write_text("{")
    access.reread()
    assert access.token_of(text, HERE).role == "operate"
    assert "stay as they were" in caplog.text
    tokens.path.unlink()
    access.reread()
    assert access.token_of(text, HERE).role == "operate"


def test_a_session_lasts_its_hours_and_no_longer(
    access: Access, tokens: TokenList, clock: ManualClock
) -> None:
    secret, _, _ = access.log_in(token(tokens), HERE)
    held = access.session_of(secret)
    assert held is not None and held[0].role == "operate"
    clock.advance(SESSION_S - 1.0)
    assert access.session_of(secret) is not None
    clock.advance(2.0)
    assert access.session_of(secret) is None


def test_a_session_ends_with_its_token_and_by_a_log_out(access: Access, tokens: TokenList) -> None:
    first, _, _ = access.log_in(token(tokens), HERE)
    second, _, _ = access.log_in(token(tokens, "view"), HERE)
    access.log_out(second)
    assert access.session_of(second) is None
    tokens.revoke("operate")
    access.reread()
    assert access.session_of(first) is None


def test_a_session_is_no_token_and_a_token_no_session(access: Access, tokens: TokenList) -> None:
    secret, _, _ = access.log_in(token(tokens), HERE)
    assert code_of(access, secret) == "wrong_token"
    assert access.session_of(token(tokens)) is None


def test_sessions_of_a_token_are_bounded_and_its_own_oldest_goes(access: Access, tokens: TokenList) -> None:
    admins, _, _ = access.log_in(token(tokens, "admin"), HERE)
    secrets = [access.log_in(token(tokens, "view"), HERE)[0] for _ in range(200)]
    assert access.session_of(admins) is not None, "a view token's log-ins end nobody else's session"
    kept = [secret for secret in secrets if access.session_of(secret) is not None]
    assert kept == secrets[-SESSIONS_OF_ONE:]
    assert len(set(secrets)) == len(secrets)


def test_a_session_that_is_used_outlasts_those_that_are_not(access: Access, tokens: TokenList) -> None:
    used = access.log_in(token(tokens), HERE)[0]
    for _ in range(3 * SESSIONS_OF_ONE):
        access.log_in(token(tokens), HERE)
        assert access.session_of(used) is not None


def test_what_stands_is_a_token_of_the_list_and_a_session_of_one(
    access: Access, tokens: TokenList, clock: ManualClock
) -> None:
    digest = access.token_of(token(tokens), HERE).sha256
    secret, out = (access.log_in(token(tokens), HERE)[0] for _ in range(2))
    lent, take_back = access.lend("guide")
    lent_digest = access.token_of(lent, HERE).sha256
    known = digest, digest_of(secret), digest_of(out), lent_digest

    def standing() -> list[bool]:
        return [access.stands(one) for one in known]

    assert standing() == [True, True, True, True] and not access.stands("") and not access.stands("x")
    access.log_out(out)
    take_back()
    assert standing() == [True, True, False, False]
    clock.advance(SESSION_S + 1.0)
    assert standing() == [True, False, False, False]
    again = access.log_in(token(tokens), HERE)[0]
    tokens.revoke("operate")
    access.reread()
    assert standing() == [False, False, False, False] and not access.stands(digest_of(again))


def test_sessions_that_have_ended_are_not_kept(access: Access, tokens: TokenList, clock: ManualClock) -> None:
    access.log_in(token(tokens, "view"), HERE)
    access.log_in(token(tokens, "operate"), HERE)
    tokens.revoke("view")
    access.reread()
    access.log_in(token(tokens, "operate"), HERE)
    assert len(access._sessions) == 2
    clock.advance(SESSION_S + 1.0)
    access.log_in(token(tokens, "admin"), HERE)
    assert len(access._sessions) == 1


def test_who_guesses_is_not_heard_for_a_while_and_known_tokens_pass_there(
    access: Access, tokens: TokenList, clock: ManualClock
) -> None:
    for number in range(MOST_OF_ONE):
        assert code_of(access, f"guess {number}") == "wrong_token"
    for number in range(5):
        assert code_of(access, f"guess {MOST_OF_ONE + number}") == "too_many_guesses"
    assert access.token_of(token(tokens), HERE).role == "operate", "colleagues behind the same address"
    assert access.log_in(token(tokens, "admin"), HERE)[1].role == "admin"
    assert code_of(access, "guess 0") == "too_many_guesses", "a known token lifts nothing"
    assert access.token_of(token(tokens), "10.0.0.2").role == "operate", "others are heard"
    clock.advance(WINDOW_S + 1.0)
    assert code_of(access, "guess 0") == "wrong_token"


def test_a_forgotten_script_that_repeats_an_old_token_keeps_nobody_out(
    access: Access, tokens: TokenList
) -> None:
    for _ in range(100):
        assert code_of(access, "revoked long ago") == "wrong_token"
    assert access.token_of(token(tokens), HERE).role == "operate"


def test_guesses_from_many_addresses_close_the_door_to_guessers_only(
    access: Access, tokens: TokenList
) -> None:
    for number in range(MOST_OF_ALL):
        code_of(access, f"guess {number}", f"10.1.0.{number}")
    assert code_of(access, "one more", "10.1.0.7") == "too_many_guesses"
    assert code_of(access, "the first", "10.2.0.1") == "wrong_token"
    assert access.token_of(token(tokens), "10.1.0.7").role == "operate"


def test_a_wrong_token_is_logged_once_a_minute_with_the_address_and_never_itself(
    access: Access, tokens: TokenList, caplog: pytest.LogCaptureFixture
) -> None:
    for number in range(5):
        code_of(access, f"nearly-{number}-{token(tokens)}")
    assert caplog.text.count(HERE) == 1
    assert "nearly" not in caplog.text


def test_guesses_take_bounded_memory() -> None:
    guesses = Guesses()
    for number in range(MOST_ADDRESSES + 50):
        guesses.wrong(f"10.{number >> 8}.{number & 255}.1", str(number), 0.0)
    assert len(guesses._wrong) == MOST_ADDRESSES
    assert guesses.wait_s("10.9.9.9", WINDOW_S + 1.0) == 0.0
    assert not guesses._wrong


@pytest.mark.parametrize(
    ("address", "counted"),
    [
        ("10.0.0.1", "10.0.0.1"),
        ("::ffff:10.0.0.1", "10.0.0.1"),
        ("2001:db8::1", "2001:db8::"),
        ("2001:db8::ffff:1", "2001:db8::"),
        ("2001:db8:0:1::1", "2001:db8:0:1::"),
        ("fe80::1%eth0", "fe80::"),
        ("a socket of this machine", "a socket of this machine"),
    ],
)
def test_an_ipv6_network_counts_as_one_address(address: str, counted: str) -> None:
    assert neighbourhood(address) == counted
