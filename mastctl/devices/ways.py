"""A way round the keep-outs: moves one after the other, each free over its whole rectangle.

Corners lie where edges of boxes, start and goal cross. Along such lines there is a way if there is one at
all: any way of free rectangles can be pushed against the edges without entering a box. Corners keep a little
more room than they must, since a head rests a little off them; where that leaves no way, what they must.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mastctl.devices.keep_out import TOUCH_RAD, KeepOuts, NoWay, Pair, Span

CORNER_S = 0.6  # what a corner costs beside the way: braking, dwelling until rest is known, starting again
OFF_RAD = 6e-3  # how far off a corner a head may rest: as far as an arrival is let pass
MOST_CORNERS = 100  # of a way; more would be a defect

Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Way:
    """Where the head goes, one goal after the other, the last one being what was asked for.

    Attributes
    ----------
    goals
        (pan, tilt), radians.
    time_s
        About how long it takes: distances over the speed, and a share for each corner.
    """

    goals: tuple[Pair, ...]
    time_s: float


def plan(keep_outs: KeepOuts, here: Pair, goal: Pair, speed_rad_per_s: float) -> Way:
    """Return the fastest way from where the head rests to a goal.

    Parameters
    ----------
    keep_outs
        Boxes, the room around them and joint limits.
    here, goal
        (pan, tilt), radians.
    speed_rad_per_s
        Of either axis.

    Raises
    ------
    KeptOut
        If the goal is in a keep-out.
    NoWay
        If there is none: around the keep-outs and within the limits, or out of the one that holds the head.
    """
    keep_outs.check_goal(goal)
    start, legs = here, list[Pair]()
    held = keep_outs.holding(Span.around(here))
    if held:
        out = keep_outs.way_out(here)
        if out is None:
            words = f"the head stands in the {held[0].told()}, and no way along one axis leads out of it"
            raise NoWay(f"{words}; turn it by hand")
        legs.append(out)
        start = out
    way = None
    for more_rad in (OFF_RAD, 0.0):
        way = way or _fastest(_WayGrid(keep_outs, start, goal, more_rad), speed_rad_per_s)
    if way is None:
        names = ", ".join(sorted({box.name for box in keep_outs.boxes}))
        raise NoWay(
            f"no way leads from pan {here[0]:.4g}, tilt {here[1]:.4g} to pan {goal[0]:.4g}, tilt "
            f"{goal[1]:.4g} rad around the keep-outs ({names}) within the limits"
        )
    goals = (*legs, *way)
    if len(goals) > 1 and goals[-1] == goals[-2]:
        goals = goals[:-1]
    return Way(goals, duration_s(here, goals, speed_rad_per_s))


def duration_s(here: Pair, goals: tuple[Pair, ...], speed_rad_per_s: float) -> float:
    """Return about how long a way takes, seconds."""
    places = (here, *goals)
    far = sum(max(abs(b[0] - a[0]), abs(b[1] - a[1])) for a, b in pairwise(places))
    return far / speed_rad_per_s + CORNER_S * (len(goals) - 1)


class _WayGrid:
    """The plane cut along every edge: lines at even, the cells between them at odd numbers."""

    def __init__(self, keep_outs: KeepOuts, start: Pair, goal: Pair, more_rad: float) -> None:
        self._keep_outs = keep_outs
        self._from = Span.around(start)
        spans = [
            full.grown(more, more)
            for full in keep_outs.full
            for more in [min(more_rad, max(0.0, Span.around(goal).gap(full)))]
        ]
        self.pans = _lines([s.pan_rad for s in spans], keep_outs.pan_rad, start[0], goal[0])
        self.tilts = _lines([s.tilt_rad for s in spans], keep_outs.tilt_rad, start[1], goal[1])
        self.start = _index(self.pans, start[0]), _index(self.tilts, start[1])
        self.goal = _index(self.pans, goal[0]), _index(self.tilts, goal[1])
        full = self._taken(spans)
        self._sums = _summed(full)
        inside = [
            (lines >= low - 1e-12) & (lines <= high + 1e-12)
            for lines, (low, high) in ((self.pans, keep_outs.pan_rad), (self.tilts, keep_outs.tilt_rad))
        ]
        self.stand = ~full[::2, ::2] & inside[0][:, None] & inside[1][None, :]

    def reached(self, node: tuple[int, int], first: bool) -> Flags:
        """Which corners one move leads to, as flags over all of them."""
        if first:
            return self._reached_at_once() & self.stand
        sums = self._sums
        bounds = []
        for here, lines in zip(node, (self.pans, self.tilts), strict=True):
            others = np.arange(len(lines))
            bounds.append((2 * np.minimum(others, here), 2 * np.maximum(others, here) + 1))
        (i0, i1), (j0, j1) = bounds
        taken = sums[np.ix_(i1, j1)] - sums[np.ix_(i0, j1)] - sums[np.ix_(i1, j0)] + sums[np.ix_(i0, j0)]
        reached: Flags = (taken == 0) & self.stand
        return reached

    def _reached_at_once(self) -> Flags:
        """Which corners the first move leads to, judged as the door will."""
        free = np.ones((len(self.pans), len(self.tilts)), dtype=bool)
        beyond = self._keep_outs.beyond_rad
        pan, tilt = (
            (np.minimum(here[0], lines - past), np.maximum(here[1], lines + past))
            for here, lines, past in zip(
                (self._from.pan_rad, self._from.tilt_rad), (self.pans, self.tilts), beyond, strict=True
            )
        )
        for box in self._keep_outs.near(self._from):
            across = (pan[0] < box.pan_rad[1] - TOUCH_RAD) & (pan[1] > box.pan_rad[0] + TOUCH_RAD)
            along = (tilt[0] < box.tilt_rad[1] - TOUCH_RAD) & (tilt[1] > box.tilt_rad[0] + TOUCH_RAD)
            free &= ~(across[:, None] & along[None, :])
        return free

    def _taken(self, spans: Sequence[Span]) -> Flags:
        """Which lines, cells and crossings lie inside a box."""
        taken = np.zeros((2 * len(self.pans) - 1, 2 * len(self.tilts) - 1), dtype=bool)
        for span in spans:
            pan = _between(self.pans, *span.pan_rad)
            tilt = _between(self.tilts, *span.tilt_rad)
            taken[pan, tilt] = True
        return taken


def _fastest(grid: _WayGrid, speed_rad_per_s: float) -> tuple[Pair, ...] | None:
    """Dijkstra's way over the corners; None if the goal is not reached."""
    shape = len(grid.pans), len(grid.tilts)
    cost = np.full(shape, math.inf)
    before: dict[tuple[int, int], tuple[int, int]] = {}
    done = np.zeros(shape, dtype=bool)
    cost[grid.start] = 0.0
    queue = [(0.0, grid.start)]
    while queue:
        so_far, node = heapq.heappop(queue)
        if done[node]:
            continue
        done[node] = True
        if node == grid.goal:
            break
        far = np.maximum(
            np.abs(grid.pans - grid.pans[node[0]])[:, None], np.abs(grid.tilts - grid.tilts[node[1]])[None, :]
        )
        then = so_far + far / speed_rad_per_s + CORNER_S
        better = grid.reached(node, first=node == grid.start) & (then < cost - 1e-12) & ~done
        for i, j in np.argwhere(better).tolist():
            cost[i, j] = then[i, j]
            before[i, j] = node
            heapq.heappush(queue, (float(then[i, j]), (i, j)))
    if not done[grid.goal]:
        return None
    goals = [grid.goal]
    while goals[-1] != grid.start and len(goals) < MOST_CORNERS:
        goals.append(before[goals[-1]])
    corners = goals[-2::-1] if len(goals) > 1 else goals
    return tuple((float(grid.pans[i]), float(grid.tilts[j])) for i, j in corners)


def _lines(edges: list[Pair], limits: Pair, start: float, goal: float) -> NDArray[np.float64]:
    """Where corners may lie on one axis, rising; start and goal stand exactly as they are."""
    inside = [edge for pair in edges for edge in pair if limits[0] <= edge <= limits[1]]
    lines = [start] if start == goal else sorted((start, goal))
    for edge in sorted(inside):
        if all(abs(edge - kept) > 1e-12 for kept in lines):
            lines.append(edge)
    return np.array(sorted(lines))


def _index(lines: NDArray[np.float64], value: float) -> int:
    return int(np.argmin(np.abs(lines - value)))


def _between(lines: NDArray[np.float64], low: float, high: float) -> slice:
    """The doubled numbers of what lies inside an open interval: lines, and cells between them."""
    first = int(np.searchsorted(lines, low + 1e-9, side="right"))  # the first line inside
    last = int(np.searchsorted(lines, high - 1e-9, side="left")) - 1  # the last line inside
    return slice(max(2 * first - 1, 0), min(2 * last + 2, 2 * len(lines) - 1))


def _summed(taken: Flags) -> NDArray[np.int64]:
    """Sums over all rectangles from the first corner on, one row and column of zeros before them."""
    sums = np.zeros((taken.shape[0] + 1, taken.shape[1] + 1), dtype=np.int64)
    sums[1:, 1:] = taken.astype(np.int64).cumsum(axis=0).cumsum(axis=1)
    return sums
