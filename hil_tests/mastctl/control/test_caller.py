"""Who asks: names that anybody may tell, and roles that each include those before."""

from __future__ import annotations

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from mastctl.control.lease import ANONYMOUS, LONGEST_NAME, ROLES, Caller, client_name
from mastctl.errors import NotAllowed


@pytest.mark.parametrize(("role", "may"), [("view", (1, 0, 0)), ("operate", (1, 1, 0)), ("admin", (1, 1, 1))])
def test_a_role_may_what_those_before_it_may(role: str, may: tuple[int, ...]) -> None:
    caller = Caller("bench", role)  # type: ignore[arg-type]
    assert tuple(map(int, map(caller.may, ROLES))) == may


def test_who_may_not_is_told_which_role_it_needs() -> None:
    with pytest.raises(NotAllowed, match="bench may view; point needs the role operate") as refusal:
        Caller("bench", "view").check_may("operate", "point")
    assert refusal.value.code == "role"


def test_who_tells_no_name_is_anonymous() -> None:
    assert {client_name(header) for header in (None, "", "  ", "\t")} == {ANONYMOUS}


@example("a" * 500)
@example("\u00c2\u00a1\x80")  # UTF-8 but for its last sign
@given(st.text())
def test_any_header_makes_a_name_of_one_printable_line(header: str) -> None:
    name = client_name(header)
    assert name.isprintable()
    assert 0 < len(name) <= LONGEST_NAME
    assert client_name(name.encode().decode("latin-1")) == name, "as a header of UTF-8 comes"
