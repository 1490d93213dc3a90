"""Where the head must not be: boxes in pan and tilt, and whether a move could enter one.

The two axes of a head turn each at its own pace, so between its start and its goal it may be anywhere in the
rectangle that both span, and beyond its goal by as much as it passes it on purpose to come back to it from
one side. A move is free if all this keeps the margin of every box: what a head overshoots. A box itself is
open: its edge may be touched. Pan angles a whole turn apart show the same place, so a box exists once a turn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

from mastctl.errors import BadRequest

Pair = tuple[float, float]

SPAN_PARTS = 32
TOUCH_RAD = 1e-9  # closer than this is the edge itself
ASIDE_RAD = 5e-3  # a move along one axis leaves the other where it was read: three counts of a 12-bit servo


class KeptOut(BadRequest):
    """A goal, or the move to it, lies in a keep-out.

    ``nearest`` is the goal nearest to the refused one that the head may be sent to: (pan, tilt), radians;
    None if it was not searched, or there is none.
    """

    def __init__(self, name: str, message: str, nearest: Pair | None = None) -> None:
        self.name = name
        self.nearest = nearest
        super().__init__("keep_out", message)

    @property
    def detail(self) -> dict[str, str | Pair | None]:
        """The same for programs."""
        return {"keep_out": self.name, "nearest_rad": self.nearest}


@dataclass(frozen=True)
class Span:
    """A rectangle in pan and tilt: (lowest, highest) of each, radians."""

    pan_rad: Pair
    tilt_rad: Pair

    @staticmethod
    def around(*points: Pair) -> Span:
        """Return the smallest one that holds these (pan, tilt)."""
        pans, tilts = zip(*points, strict=True)
        return Span((min(pans), max(pans)), (min(tilts), max(tilts)))

    @property
    def corners(self) -> tuple[Pair, Pair]:
        """The lowest and the highest (pan, tilt)."""
        return (self.pan_rad[0], self.tilt_rad[0]), (self.pan_rad[1], self.tilt_rad[1])

    def grown(self, pan_rad: float, tilt_rad: float) -> Span:
        """Return it wider by so much at each end."""
        (pan_low, tilt_low), (pan_high, tilt_high) = self.corners
        return Span((pan_low - pan_rad, pan_high + pan_rad), (tilt_low - tilt_rad, tilt_high + tilt_rad))

    def overlap(self, other: Span) -> Span | None:
        """Return what both hold; None if that is nothing."""
        pan, tilt = (
            (max(a[0], b[0]), min(a[1], b[1]))
            for a, b in ((self.pan_rad, other.pan_rad), (self.tilt_rad, other.tilt_rad))
        )
        return Span(pan, tilt) if pan[0] <= pan[1] and tilt[0] <= tilt[1] else None

    def gap(self, other: Span) -> float:
        """Return how far apart two are: the larger of pan's and tilt's distance, negative if they overlap."""
        pairs = (self.pan_rad, other.pan_rad), (self.tilt_rad, other.tilt_rad)
        return max(max(theirs[0] - mine[1], mine[0] - theirs[1]) for mine, theirs in pairs)

    def enters(self, open_box: Span) -> bool:
        """Return whether any of it lies inside another one, whose edge does not count."""
        return self.gap(open_box) < -TOUCH_RAD


@dataclass(frozen=True)
class Box:
    """A named keep-out; pan is taken round the circle, so that it may lie anywhere in a turn or past ±π."""

    name: str
    pan_rad: Pair
    tilt_rad: Pair

    @property
    def span(self) -> Span:
        """Its rectangle, without its slack."""
        return Span(self.pan_rad, self.tilt_rad)

    def within(self, pan_rad: Pair) -> list[Box]:
        """Return its copies, whole turns apart, that reach into a range of pan."""
        low, high = self.pan_rad
        first, last = math.ceil((pan_rad[0] - high) / math.tau), math.floor((pan_rad[1] - low) / math.tau)
        turns = [turn * math.tau for turn in range(first, last + 1)]
        return [Box(self.name, (low + turn, high + turn), self.tilt_rad) for turn in turns]

    def __str__(self) -> str:
        pan, tilt = (f"{low:.4g} to {high:.4g}" for low, high in (self.pan_rad, self.tilt_rad))
        return f"keep-out {self.name} (pan {pan}, tilt {tilt} rad)"


@dataclass(frozen=True)
class KeepOuts:
    """All boxes of a moment, copies over the whole range of pan included, with a margin around each.

    ``beyond_rad`` is how far the head may pass a goal on purpose, in pan and in tilt. A path out of a box,
    and a nearest free goal, lie within the joint limits ``pan_rad`` and ``tilt_rad``.
    """

    boxes: tuple[Box, ...]
    margin_rad: float
    beyond_rad: Pair
    pan_rad: Pair
    tilt_rad: Pair

    @property
    def slack_rad(self) -> Pair:
        """What no goal is nearer than, in pan and in tilt."""
        return self.margin_rad + self.beyond_rad[0], self.margin_rad + self.beyond_rad[1]

    @cached_property
    def full(self) -> tuple[Span, ...]:
        """Every box, grown by the slack."""
        return tuple(box.span.grown(*self.slack_rad) for box in self.boxes)

    def holding(self, place: Span) -> list[Box]:
        """Return the boxes that a place reaches into, their margin left aside."""
        return [box for box in self.boxes if place.enters(box.span)]

    def check_goal(self, goal: Pair) -> None:
        """Pass a goal that lies in no box nor too near to one. Raises KeptOut."""
        refusal = self._goal_refusal(goal)
        if refusal is not None:
            raise refusal

    def check_move(self, start: Span, goal: Pair, rests: bool) -> None:
        """Pass a move from anywhere in ``start`` to a goal.

        A head in the margin of a box may go where that is not nearer. One in a box itself may leave it the
        shortest way along one axis, from rest. Raises KeptOut, with the nearest free goal, if any place that
        the head may pass is kept out.
        """
        refusal = self._refusal(start, goal, rests)
        if refusal is not None:
            nearest = self.nearest_free(start, goal, rests)
            advice = "from there no goal is free"
            if nearest is not None:
                advice = f"the nearest goal that is free from there is {_text(nearest)}"
            raise KeptOut(refusal.name, f"{refusal}; {advice}", nearest)

    def allows(self, start: Span, goal: Pair, rests: bool) -> bool:
        """Return whether `check_move` passes a move."""
        return self._refusal(start, goal, rests) is None

    def free_span(self, place: Pair, most: Span) -> Span | None:
        """Return ``most``, shrunk evenly towards a place in it until no keep-out reaches into it, or None."""
        for part in range(SPAN_PARTS, -1, -1):
            share = part / SPAN_PARTS
            low, high = (
                (place[0] + share * (pan - place[0]), place[1] + share * (tilt - place[1]))
                for pan, tilt in most.corners
            )
            span = Span.around(low, high) if part < SPAN_PARTS else most
            if not any(span.enters(full) for full in self.full):
                return span
        return None

    def nearest_free(self, start: Span, goal: Pair, rests: bool) -> Pair | None:
        """Return the goal nearest to a refused one to which the head may go from a start; None if none.

        What may be reached is bounded by edges of boxes, grown by the room that goals and moves keep. So each
        coordinate of the nearest one lies on such an edge, or is the start's, the goal's or a limit's.
        """
        middle = _middle(start)
        out = self.way_out(middle) if self.holding(start) else None
        lines = []
        for axis, limits in enumerate((self.pan_rad, self.tilt_rad)):
            past = self.beyond_rad[axis]
            edges = {middle[axis], min(max(goal[axis], limits[0]), limits[1]), *limits}
            edges |= {edge for full in self.full for edge in (full.pan_rad, full.tilt_rad)[axis]}
            for near in self._near(start):
                low, high = (near.pan_rad, near.tilt_rad)[axis]
                edges |= {low - past, high + past}
            if out is not None:
                edges.add(out[axis])
            lines.append([edge for edge in edges if limits[0] <= edge <= limits[1]])
        places = ((pan, tilt) for pan in lines[0] for tilt in lines[1])
        by_distance = sorted(places, key=lambda one: (math.dist(one, goal), one))
        return next((one for one in by_distance if self.allows(start, one, rests)), None)

    def way_out(self, place: Pair) -> Pair | None:
        """Return where the shortest way along one axis leaves the boxes that hold the head.

        It passes no other keep-out and ends within the joint limits; None if there is none.
        """
        names = {box.name for box in self.holding(Span.around(place))}
        found = []
        for axis, limits in ((0, self.pan_rad), (1, self.tilt_rad)):
            for side in (-1, 1):
                end = self._end_along(place, axis, side, names)
                if end is not None and limits[0] <= end[axis] <= limits[1]:
                    found.append((abs(end[axis] - place[axis]), end))
        return min(found)[1] if found else None

    def _end_along(self, place: Pair, axis: int, side: int, names: set[str]) -> Pair | None:
        """The first place in one direction where a goal may be; None if another keep-out comes before."""
        end = place
        for _ in range(2 * len(self.boxes) + 1):
            point = Span.around(end)
            inside = [full for full in self.full if point.enters(full)]
            if not inside:
                way = Span.around(place, end)
                other = [box for box in self.boxes if box.name not in names and way.enters(box.span)]
                return None if other else end
            edges = [(full.pan_rad, full.tilt_rad)[axis][side > 0] for full in inside]
            edge = max(edges) if side > 0 else min(edges)
            end = (edge, end[1]) if axis == 0 else (end[0], edge)
        return None

    def _goal_refusal(self, goal: Pair) -> KeptOut | None:
        point = Span.around(goal)
        for box, full in zip(self.boxes, self.full, strict=True):
            if point.enters(full):
                where = "in" if point.enters(box.span) else "too near to"
                return KeptOut(box.name, f"{_text(goal)} is {where} the {box}{self._slack_text()}")
        return None

    def _refusal(self, start: Span, goal: Pair, rests: bool) -> KeptOut | None:
        """Why a move may not go out, None if it may."""
        refusal = self._goal_refusal(goal)
        if refusal is not None:
            return refusal
        inside = self.holding(start)
        if inside:
            return self._leaving_refusal(start, goal, rests, inside[0])
        way = Span.around(*start.corners, *Span.around(goal).grown(*self.beyond_rad).corners)
        for box, near in zip(self.boxes, self._near(start), strict=True):
            if way.enters(near):
                between = f"between {_text(_middle(start))} and {_text(goal)} the head may pass the {box}"
                return KeptOut(box.name, f"{between}{self._slack_text()}: each axis goes at its own pace")
        return None

    def _leaving_refusal(self, start: Span, goal: Pair, rests: bool, box: Box) -> KeptOut | None:
        """Why a move may not go out from inside a box, None if it leads out of it."""
        at = _middle(start)
        inside = f"the head stands in the {box}"
        if not rests:
            return KeptOut(box.name, f"{inside} and moves; it is led out when it rests")
        end = self.way_out(at)
        if end is None:
            return KeptOut(box.name, f"{inside}, and no way along one axis leads out of it; turn it by hand")
        axis = 0 if abs(end[0] - at[0]) > abs(end[1] - at[1]) else 1
        out = end[axis] - at[axis]
        along = (goal[axis] - end[axis]) * math.copysign(1.0, out) >= -ASIDE_RAD
        rest = Span.around((goal[0], at[1]) if axis == 0 else (at[0], goal[1]), end)
        aside = abs(goal[1 - axis] - at[1 - axis]) > ASIDE_RAD
        if along and not aside and not any(rest.enters(full) for full in self.full):
            return None
        return KeptOut(box.name, f"{inside}; the one move that is taken from there is out, to {_text(end)}")

    def _near(self, start: Span) -> list[Span]:
        """Every box with as much of its margin as a start leaves: nearer than it is, nothing goes."""
        margins = [min(self.margin_rad, max(0.0, start.gap(box.span))) for box in self.boxes]
        return [box.span.grown(margin, margin) for box, margin in zip(self.boxes, margins, strict=True)]

    def _slack_text(self) -> str:
        pan, tilt = self.slack_rad
        if pan == tilt:
            return f" with {pan:.3g} rad around it" if pan > 0.0 else ""
        return f" with {pan:.3g} rad around it in pan and {tilt:.3g} rad in tilt"


def _middle(span: Span) -> Pair:
    return sum(span.pan_rad) / 2, sum(span.tilt_rad) / 2


def _text(place: Pair) -> str:
    return f"pan {place[0]:.4g}, tilt {place[1]:.4g} rad"
