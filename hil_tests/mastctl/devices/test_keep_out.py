"""Keep-outs: what a move may pass, the nearest free goal by a fine grid, the path out of a box."""

from __future__ import annotations

import math
import random

import pytest

from mastctl.devices.keep_out import ASIDE_RAD, Box, KeepOuts, KeptOut, Pair, Span

PAN, TILT = (-2.5, 2.5), (-1.2, 0.6)
MARGIN = 0.02
DECK = Box("deck", (-1.0, 1.0), (-1.2, -0.8))
ANTENNA = Box("antenna", (1.4, 1.6), (-0.6, 0.2))


def kept(
    *boxes: Box, margin: float = MARGIN, beyond: Pair = (0.0, 0.0), pan: Pair = PAN, tilt: Pair = TILT
) -> KeepOuts:
    copies = tuple(copy for box in boxes for copy in box.within((pan[0] - math.pi, pan[1] + math.pi)))
    return KeepOuts(copies, margin, beyond, pan, tilt)


def allowed(keep_outs: KeepOuts, start: Pair, goal: Pair, rests: bool = True) -> bool:
    return keep_outs.allows(Span.around(start), goal, rests)


def test_a_goal_in_a_box_or_its_margin_is_refused_by_name() -> None:
    keep_outs = kept(DECK)
    with pytest.raises(
        KeptOut, match=r"is in the keep-out deck \(pan -1 to 1, tilt -1.2 to -0.8 rad\)"
    ) as at:
        keep_outs.check_goal((0.5, -0.9))
    assert (at.value.code, at.value.name, at.value.detail) == (
        "keep_out",
        "deck",
        {"keep_out": "deck", "nearest_rad": None},
    )
    with pytest.raises(KeptOut, match="is too near to the keep-out deck"):
        keep_outs.check_goal((0.5, -0.8 + MARGIN / 2))
    keep_outs.check_goal((0.5, -0.8 + MARGIN))


def test_a_move_whose_rectangle_holds_a_box_is_refused() -> None:
    keep_outs = kept(Box("mast_light", (0.9, 1.1), (-1.1, -0.9)))
    assert not allowed(keep_outs, (0.0, 0.0), (1.2, -1.2)), "the diagonal passes, the axes may not"
    assert allowed(keep_outs, (0.0, 0.0), (0.8, -1.2))
    assert allowed(keep_outs, (0.0, -0.8), (2.0, 0.0))


def test_a_box_is_there_once_a_turn_where_the_pan_turns_further() -> None:
    keep_outs = kept(Box("antenna", (3.0, 3.3), (-0.5, 0.5)), pan=(-4.5, 4.5))
    for goal in ((3.1, 0.0), (3.1 - math.tau, 0.0)):
        with pytest.raises(KeptOut, match="antenna"):
            keep_outs.check_goal(goal)
    assert [round(box.pan_rad[0], 3) for box in Box("a", (-0.1, 0.1), (0, 1)).within((-7, 7))] == [
        -6.383, -0.1, 6.183,
    ]  # fmt: skip


def test_a_head_in_the_margin_may_go_along_and_away_but_no_nearer() -> None:
    keep_outs = kept(DECK)
    start = 0.0, -0.8 + 0.25 * MARGIN
    assert allowed(keep_outs, start, (0.0, 0.0))
    assert allowed(keep_outs, start, (1.5, -0.7)), "sideways, and away"
    assert not allowed(keep_outs, start, (0.5, start[1])), "a goal in the margin"
    assert not allowed(keep_outs, start, (1.5, -0.9)), "the rectangle holds a corner of the deck"


def test_a_head_in_a_box_may_only_leave_it_along_one_axis() -> None:
    keep_outs = kept(DECK)
    here = 0.5, -0.9
    assert keep_outs.way_out(here) == pytest.approx((0.5, -0.8 + MARGIN))
    assert allowed(keep_outs, here, (0.5, -0.78))
    assert allowed(keep_outs, here, (0.5, 0.3)), "and further the same way"
    for goal in ((0.5, -0.85), (1.1, -0.9), (1.1, -0.7), (0.5, -1.1), (0.0, -0.78)):
        with pytest.raises(KeptOut):
            keep_outs.check_move(Span.around(here), goal, True)
    with pytest.raises(KeptOut, match=r"the one move .* is out, to pan 0\.5, tilt -0\.78"):
        keep_outs.check_move(Span.around(here), (1.1, -0.7), True)
    with pytest.raises(KeptOut, match="led out when it rests"):
        keep_outs.check_move(Span.around(here), (0.5, -0.78), False)


def test_the_way_out_passes_no_other_keep_out_and_ends_within_the_limits() -> None:
    over = Box("antenna", (-1.0, 1.0), (-0.79, 0.5))
    keep_outs = kept(DECK, over)
    assert keep_outs.way_out((0.9, -0.81)) == pytest.approx((1.0 + MARGIN, -0.81)), "up is the antenna"
    walled = kept(DECK, over, pan=(-0.9, 0.9))
    assert walled.way_out((0.0, -0.9)) is None
    with pytest.raises(KeptOut, match=r"turn it by hand; from there no goal is free") as refused:
        walled.check_move(Span.around((0.0, -0.9)), (0.0, 0.55), True)
    assert refused.value.nearest is None


def test_the_way_out_of_boxes_that_overlap_leaves_all_of_them() -> None:
    keep_outs = kept(Box("a", (-0.5, 0.5), (-0.5, 0.0)), Box("a", (-0.5, 0.5), (-0.1, 0.1)))
    assert keep_outs.way_out((0.0, -0.05)) == pytest.approx((0.0, 0.1 + MARGIN))


def test_a_refused_move_names_the_nearest_goal_that_is_free() -> None:
    keep_outs = kept(DECK, ANTENNA)
    with pytest.raises(KeptOut, match=r"deck .* the nearest goal .* pan 1\.3, tilt -0\.78 rad") as refused:
        keep_outs.check_move(Span.around((0.0, 0.0)), (1.3, -1.0), True)
    assert refused.value.nearest == pytest.approx((1.3, -0.8 + MARGIN))
    assert refused.value.detail["nearest_rad"] == refused.value.nearest
    with pytest.raises(KeptOut, match=r"in the keep-out deck .* pan 0\.5, tilt -0\.78 rad"):
        keep_outs.check_move(Span.around((0.0, 0.0)), (0.5, -0.9), True)
    with pytest.raises(KeptOut) as inside:
        keep_outs.check_move(Span.around((0.5, -0.9)), (1.3, -1.0), True)
    assert inside.value.nearest == pytest.approx((0.5, -0.8 + MARGIN)), "out of the box first"


def test_no_free_place_of_a_fine_grid_is_nearer_than_the_goal_named() -> None:
    draw, searched = random.Random(11), 0

    def within(low: float, high: float, longest: float) -> Pair:
        edge = draw.uniform(low, high)
        return edge, edge + draw.uniform(0.05, longest)

    for _ in range(60):
        boxes = [Box(str(number), within(-1.0, 0.8, 0.9), within(-0.6, 0.4, 0.5)) for number in range(3)]
        beyond = draw.choice(((0.0, 0.0), (0.05, 0.0)))
        keep_outs = kept(*boxes, margin=0.04, beyond=beyond, pan=(-1.0, 1.0), tilt=(-0.5, 0.5))
        here, goal = ((draw.uniform(-1.0, 1.0), draw.uniform(-0.5, 0.5)) for _ in range(2))
        if allowed(keep_outs, here, goal):
            continue
        grid = [(0.04 * i, 0.04 * j) for i in range(-25, 26) for j in range(-12, 13)]
        free = [math.dist(place, goal) for place in grid if allowed(keep_outs, here, place)]
        nearest = keep_outs.nearest_free(Span.around(here), goal, True)
        if nearest is None:
            assert not free, (boxes, here, goal)
            continue
        searched += 1
        assert allowed(keep_outs, here, nearest)
        inside = keep_outs.holding(Span.around(here))
        tolerance_rad = ASIDE_RAD if inside else 1e-9  # out of a box the other axis may give by that
        assert not free or math.dist(nearest, goal) <= min(free) + tolerance_rad, (boxes, here, goal)
    assert searched > 20


def test_the_free_span_about_a_place_has_it_and_no_keep_out() -> None:
    draw = random.Random(4)

    def between(low: float, high: float) -> Pair:
        one, other = sorted(draw.uniform(low, high) for _ in range(2))
        return one, other + 0.01

    most, found = Span((-1.0, 1.0), (-0.5, 0.5)), 0
    for _ in range(300):
        boxes = tuple(
            Box(str(number), between(-1.2, 1.2), between(-0.6, 0.6)) for number in range(draw.randint(1, 4))
        )
        keep_outs = KeepOuts(boxes, 0.02, (0.03, 0.0), most.pan_rad, most.tilt_rad)
        here = draw.uniform(-1.0, 1.0), draw.uniform(-0.5, 0.5)
        room, free = (
            keep_outs.free_span(here, most),
            not any(Span.around(here).enters(one) for one in keep_outs.full),
        )
        assert (room is not None) == free, (boxes, here)
        if room is None:
            continue
        found += 1
        assert room.overlap(most) == room and Span.around(here, *room.corners) == room
        for corner in room.corners:  # each move in it goes out
            keep_outs.check_move(Span.around(here), corner, True)
        wide = Span((-2.6, 2.6), (-1.2, 0.5))
        free_of_all = KeepOuts((), 0.0, (0.0, 0.0), wide.pan_rad, wide.tilt_rad)
        assert free_of_all.free_span(here, wide) == wide, "a limit is met, not passed by rounding"
    assert 50 < found < 250
