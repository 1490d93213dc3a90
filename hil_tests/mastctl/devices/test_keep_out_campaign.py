"""The short form of the campaign: simulated heads among random boxes, by their true angles."""

from __future__ import annotations

from tools.campaigns.keep_out import case

HEADS, ACTIONS = "abcdef", 6


def test_no_head_enters_a_keep_out_whatever_it_is_sent_through_the_door() -> None:
    found = [case(f"suite/{name}", actions=ACTIONS) for name in HEADS]
    assert [round(one.deepest_rad, 6) for one in found] == [0.0] * len(HEADS)
    assert sum(one.counts["sent"] + one.counts["jog"] + one.counts["round"] for one in found) > 20


def test_past_the_door_a_head_enters_them() -> None:
    assert case("suite/b", checked=False, actions=ACTIONS).deepest_rad > 0.01
