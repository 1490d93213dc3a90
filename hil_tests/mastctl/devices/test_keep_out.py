"""Keep-outs: what a move may pass, the way round against a search on a fine grid, the way out of a box."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator

import numpy as np
import pytest
from scipy.ndimage import label

from mastctl.devices.keep_out import Box, KeepOuts, KeptOut, NoWay, Pair, Span
from mastctl.devices.ways import CORNER_S, OFF_RAD, plan

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
    try:
        keep_outs.check_move(Span.around(start), goal, rests)
    except KeptOut:
        return False
    return True


def test_a_goal_in_a_box_or_its_margin_is_refused_by_name() -> None:
    keep_outs = kept(DECK)
    with pytest.raises(
        KeptOut, match=r"is in the keep-out deck \(pan -1 to 1, tilt -1.2 to -0.8 rad\)"
    ) as at:
        keep_outs.check_goal((0.5, -0.9))
    assert (at.value.code, at.value.name, at.value.detail) == ("keep_out", "deck", {"keep_out": "deck"})
    with pytest.raises(KeptOut, match="is too near to the keep-out deck"):
        keep_outs.check_goal((0.5, -0.8 + MARGIN / 2))
    keep_outs.check_goal((0.5, -0.8 + MARGIN))


def test_a_move_whose_rectangle_holds_a_box_is_refused_although_its_diagonal_passes_by() -> None:
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


def test_a_head_in_a_box_may_only_leave_it_by_the_shortest_way_along_one_axis() -> None:
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
    with pytest.raises(NoWay, match="turn it by hand"):
        plan(walled, (0.0, -0.9), (0.0, 0.55), 1.0)


def test_the_way_out_of_boxes_that_overlap_leaves_all_of_them() -> None:
    keep_outs = kept(Box("a", (-0.5, 0.5), (-0.5, 0.0)), Box("a", (-0.5, 0.5), (-0.1, 0.1)))
    assert keep_outs.way_out((0.0, -0.05)) == pytest.approx((0.0, 0.1 + MARGIN))


def test_a_plan_leads_round_by_corners_that_the_door_lets_through() -> None:
    keep_outs = kept(DECK, ANTENNA)
    way = plan(keep_outs, (-1.5, -1.0), (1.3, -1.0), 0.5)
    assert len(way.goals) == 3
    assert way.goals[-1] == (1.3, -1.0)
    assert all(goal[1] >= -0.8 + MARGIN + OFF_RAD - 1e-9 for goal in way.goals[:-1])
    assert way.time_s == pytest.approx(
        sum(max(abs(b[0] - a[0]), abs(b[1] - a[1])) for a, b in zip(((-1.5, -1.0), *way.goals), way.goals,
                                                                 strict=False)) / 0.5 + 2 * CORNER_S
    )  # fmt: skip
    assert plan(keep_outs, (0.0, 0.0), (0.5, 0.2), 0.5).goals == ((0.5, 0.2),)


def test_where_nothing_leads_there_the_refusal_names_both_ends_and_the_keep_outs() -> None:
    wall = Box("wall", (0.4, 0.6), (-1.5, 1.0))
    with pytest.raises(NoWay, match=r"from pan 0, tilt 0 to pan 1, tilt 0.1 rad around .* \(wall\)") as none:
        plan(kept(wall), (0.0, 0.0), (1.0, 0.1), 1.0)
    assert none.value.code == "no_way"


def worlds(seed: int, count: int) -> Iterator[tuple[int, KeepOuts, Pair, Pair]]:
    """Boxes of all sizes, some as high as the whole range, and two free places."""
    rng = random.Random(seed)
    for case in range(count):
        boxes = []
        for number in range(rng.randint(1, 9)):
            pan, tilt = rng.uniform(-2.6, 2.5), rng.uniform(-1.3, 0.6)
            high = rng.choice((0.05, 0.5, 1.3))
            box = Box(
                f"b{number}", (pan, pan + rng.uniform(0.02, 1.5)), (tilt, tilt + rng.uniform(0.02, high))
            )
            boxes.append(box)
        for number in range(rng.randint(0, 3)):  # walls, some with a gap
            pan, gap = rng.uniform(-2.0, 2.0), rng.choice((0.0, 0.0, rng.uniform(0.0, 0.3)))
            tilt = rng.uniform(-1.0, 0.4)
            boxes.append(Box(f"low{number}", (pan, pan + 0.1), (-1.5, tilt)))
            boxes.append(Box(f"high{number}", (pan, pan + 0.1), (tilt + gap, 0.9)))
        keep_outs = kept(
            *boxes, margin=rng.uniform(0, 0.04), beyond=(rng.choice((0.0, 0.03)), rng.choice((0.0, 0.02)))
        )
        places = [
            place
            for place in ((rng.uniform(*PAN), rng.uniform(*TILT)) for _ in range(60))
            if not any(Span.around(place).enters(full) for full in keep_outs.full)
        ]
        if len(places) > 1:
            yield case, keep_outs, places[0], places[1]


def connected(keep_outs: KeepOuts, start: Pair, goal: Pair) -> bool | None:
    """Whether free cells of a fine grid join two places; None where one of them lies in a taken cell."""
    axes = [np.linspace(*limits, count) for limits, count in ((PAN, 501), (TILT, 181))]
    taken = np.zeros((501, 181), dtype=bool)
    for full in keep_outs.full:
        pan, tilt = (
            (axis > low) & (axis < high)
            for axis, (low, high) in zip(axes, (full.pan_rad, full.tilt_rad), strict=True)
        )
        taken |= pan[:, None] & tilt[None, :]
    parts = label(~taken)[0]
    one, other = (
        parts[tuple(int(np.abs(axis - value).argmin()) for axis, value in zip(axes, place, strict=True))]
        for place in (start, goal)
    )
    return bool(one == other) if one and other else None


@pytest.mark.parametrize("seed", range(2))
def test_a_way_is_found_where_a_search_on_a_fine_grid_finds_one_and_nowhere_else(seed: int) -> None:
    """Where the two differ, a gap narrower than a cell of the grid decides: those are counted, and few."""
    found = refused = narrow = 0
    for case, keep_outs, start, goal in worlds(seed, 200):
        try:
            goals: tuple[Pair, ...] | None = plan(keep_outs, start, goal, 1.0).goals
        except NoWay:
            goals = None
        place = start
        for corner in goals or ():
            assert allowed(keep_outs, place, corner), f"seed {seed} case {case}: {place} to {corner}"
            place = corner
        assert goals is None or place == goal, f"seed {seed} case {case}"
        found, refused = found + (goals is not None), refused + (goals is None)
        joined = connected(keep_outs, start, goal)
        if joined is not None and joined != (goals is not None):
            assert goals is not None, f"seed {seed} case {case}: the grid finds a way"
            narrow += 1
    assert found > 50 and refused > 30 and narrow <= 4, (found, refused, narrow)


def test_no_way_over_a_fine_grid_of_corners_is_much_faster() -> None:
    """Corners on the boxes' edges are not always the very best; beside free corners they lose little."""
    rng = random.Random(7)
    for case, keep_outs, start, goal in worlds(11, 60):
        try:
            way = plan(keep_outs, start, goal, 1.0)
        except NoWay:
            continue
        for _ in range(400):  # any two moves
            corner = rng.uniform(*PAN), rng.uniform(*TILT)
            if allowed(keep_outs, start, corner) and allowed(keep_outs, corner, goal):
                moves = [
                    max(abs(b[0] - a[0]), abs(b[1] - a[1])) for a, b in ((start, corner), (corner, goal))
                ]
                assert way.time_s <= sum(moves) + CORNER_S + 0.05, f"case {case}"


def test_a_head_that_rests_a_little_off_a_corner_may_still_go_on() -> None:
    """Corners keep more room than they must: a servo rests a count or two beside where it was sent."""
    rng = random.Random(3)
    legs = 0
    for case, keep_outs, start, goal in worlds(5, 120):
        try:
            way = plan(keep_outs, start, goal, 1.0)
        except NoWay:
            continue
        if len(way.goals) < 2 or any(
            box.gap(Span.around(goal)) < OFF_RAD or box.gap(Span.around(start)) < OFF_RAD
            for box in keep_outs.full
        ):
            continue  # beside a box there is no more room than that
        room = all(
            not Span.around(corner).grown(OFF_RAD, OFF_RAD).enters(full)
            for corner in way.goals[:-1]
            for full in keep_outs.full
        )
        if not room:
            continue  # only the exact corners lead there
        for corner, following in zip(way.goals, way.goals[1:], strict=False):
            off = corner[0] + rng.uniform(-OFF_RAD, OFF_RAD), corner[1] + rng.uniform(-OFF_RAD, OFF_RAD)
            assert allowed(keep_outs, off, following), f"case {case}: {off} to {following}"
            legs += 1
    assert legs > 15


def test_what_a_head_passes_on_its_approach_is_no_place_that_the_next_goal_may_use() -> None:
    """A head under way may be beyond its goal; that lets no goal come nearer to a box."""
    keep_outs = kept(Box("pole", (-0.9, -0.85), (-0.7, -0.5)), beyond=(0.05, 0.05))
    beside = -0.85 + MARGIN + 0.05
    moving = keep_outs.reach(Span.around((0.0, -0.9)), (beside, 0.0))
    keep_outs.check_move(moving, (beside, 0.1), False)
    with pytest.raises(KeptOut):
        keep_outs.check_move(moving, (beside - 0.006, 0.1), False)


def test_the_room_about_a_place_holds_it_and_no_keep_out() -> None:
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
            keep_outs.room(here, most),
            not any(Span.around(here).enters(one) for one in keep_outs.full),
        )
        assert (room is not None) == free, (boxes, here)
        if room is None:
            continue
        found += 1
        assert room.overlap(most) == room and Span.around(here, *room.corners) == room
        for corner in room.corners:  # each move in it goes out
            keep_outs.check_move(Span.around(here), corner, True)
    assert 50 < found < 250
