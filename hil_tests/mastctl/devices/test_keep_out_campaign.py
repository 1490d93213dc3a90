"""The short form of the campaign: simulated heads among random boxes, by their true angles."""

from __future__ import annotations

import pytest

from hil_tests.support.keep_out_heads import case

HEADS, ACTIONS = "abcdef", 6


def test_no_head_enters_a_keep_out_whatever_it_is_sent_through_the_door() -> None:
    found = [case(f"suite/{name}", actions=ACTIONS) for name in HEADS]
    assert [round(one.deepest_rad, 6) for one in found] == [0.0] * len(HEADS)
    assert not any(one.counts["goal refused"] for one in found)
    assert sum(one.counts["sent"] + one.counts["jog"] + one.counts["pointed"] for one in found) > 20


def test_past_the_door_a_head_enters_them() -> None:
    assert case("suite/b", checked=False, actions=ACTIONS).deepest_rad > 0.01


@pytest.mark.long(4, "200 heads; six of them are in the quick run")
def test_no_head_of_two_hundred_enters_a_keep_out() -> None:
    entered = [number for number in range(200) if case(f"1/{number}").deepest_rad > 0.0]
    assert entered == []
