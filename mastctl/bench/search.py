"""Looking for a board: first where it should stand, then ever further around it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence

import numpy as np

from calib.errors import CalibError, Unreachable
from calib.geometry.rig import Rig
from calib.plan.knowledge import Knowledge
from calib.plan.placements import Placement
from calib.plan.poses import Sought, readings
from mastctl.bench.mast import BenchLook, BenchMast, NoLight, NotThere
from mastctl.bench.reporter import Reporter
from mastctl.errors import MastctlError

OVERLAP = 0.7
"""Of a picture's view: how far apart the looks of a search are."""

ANOTHER = ("another board", "mirrored", "two boards")
"""What `calib.targets.corners` says of a board in view that is not the one that is looked for."""

MOST_LOOKS = 100
"""A narrow view would take hundreds, a quarter of an hour: the operator is asked again before."""

LOOKS_BESIDE = 8
"""Looks after such a one: the right board may hang beside it."""

MOST_KINDS = 4
"""So many things that were seen instead are reported, the most frequent."""

_NUMBERS = re.compile(r"[-+]?[0-9][0-9.]*")


class BoardNotFound(MastctlError):
    """No look within the limits showed the board."""

    code = "board_not_found"


def find_board(
    mast: BenchMast, known: Knowledge, sought: Sought, reporter: Reporter, placement: Placement
) -> BenchLook:
    """Return the first look that shows the board: where it should stand, then ever further around it.

    Views without light or with nothing in them end nothing: the board may stand beside them.

    Raises
    ------
    BoardNotFound
        With what the images showed instead, and where.
    """
    on_head = {name for name, camera in known.rig.cameras.items() if camera.on == "head"}
    attitudes = list(_attitudes(known.rig, sought, placement))
    instead = _Instead()
    for at_rad in attitudes:
        try:
            look = mast.look(*at_rad)
        except NotThere as reason:
            instead.add([str(reason)], at_rad)
            continue
        except NoLight as reason:
            reasons = [str(reason).partition("; ")[0]]
        else:
            if any(one.camera in on_head for one in look.found):
                return look
            reasons = [one.why for one in look.seen if one.why]
        instead.add(reasons, at_rad)
        instead.looks += 1
        if not instead.first_other and any(map(_is_another, reasons)):
            instead.first_other = instead.looks
        if instead.looks == 1:
            most = min(len(attitudes), MOST_LOOKS) - 1
            around = f"looking around, {most} looks at most"
            reporter.say(f"the board is not where it was requested ({instead.summary}); {around}")
        another = instead.first_other and instead.looks >= instead.first_other + LOOKS_BESIDE
        if another or instead.looks == MOST_LOOKS:
            everywhere = "" if another else " around where it was requested"
            break
    else:
        everywhere = " all over the head's limits"
    count = "1 look" if instead.looks == 1 else f"{instead.looks} looks"
    raise BoardNotFound(
        f"the board was not found in {count}{everywhere} ({instead.summary}); place it as "
        "requested, in the light, facing the head, and start the same command again"
    )


def _attitudes(rig: Rig, sought: Sought, placement: Placement) -> Iterator[tuple[float, float]]:
    """Where the board should be, then a grid of the limits from there outwards."""
    model = next(c.model for c in rig.cameras.values() if c.on == "head")
    low, high = zip(sought.pan_limits_rad, sought.tilt_limits_rad, strict=True)
    middle = placement.rover_from_board(rig.mast.rover_from_head(0.0, 0.0)).translation_m
    try:
        pan_rad, tilt_rad = readings(rig, sought, model, middle)
    except (Unreachable, CalibError, ValueError):
        pan_rad = min(max(math.radians(placement.bearing_deg), low[0]), high[0])
        tilt_rad = min(max(math.radians(placement.height_deg), low[1]), high[1])
    yield pan_rad, tilt_rad
    width, height = model.size_px
    step_pan = OVERLAP * 2 * math.atan(width / 2 / float(np.linalg.norm(model.H)))
    step_tilt = OVERLAP * 2 * math.atan(height / 2 / float(np.linalg.norm(model.V)))
    grid = [
        (p, t)
        for p in _steps(low[0], high[0], pan_rad, step_pan)
        for t in _steps(low[1], high[1], tilt_rad, step_tilt)
        if (p, t) != (pan_rad, tilt_rad)
    ]
    yield from sorted(
        grid, key=lambda at: max(abs(at[0] - pan_rad) / step_pan, abs(at[1] - tilt_rad) / step_tilt)
    )


class _Instead:
    """What looks showed instead of the board, and where."""

    def __init__(self) -> None:
        self.looks = 0
        self.first_other = 0
        self._seen: dict[str, tuple[str, list[tuple[float, float]]]] = {}

    def add(self, reasons: Sequence[str], at_rad: tuple[float, float]) -> None:
        """Keep why an attitude shows no board; the same reason with other numbers is the same."""
        for kind, reason in {_NUMBERS.sub("", reason): reason for reason in reasons}.items():
            self._seen.setdefault(kind, (reason, []))[1].append(at_rad)

    @property
    def summary(self) -> str:
        """What was seen, and where: another board first, then what most views showed."""
        if not self._seen:
            return "no corners were found"
        found = sorted(self._seen.values(), key=lambda one: (not _is_another(one[0]), -len(one[1])))
        kinds = [f"{reason}, {_place(places)}" for reason, places in found[:MOST_KINDS]]
        more = len(found) - len(kinds)
        return "; ".join([*kinds, f"{more} other reasons"] if more else kinds)


def _is_another(reason: str) -> bool:
    return any(part in reason for part in ANOTHER)


def _place(attitudes_rad: Sequence[tuple[float, float]]) -> str:
    """How often, and within which angles, as a person reads it."""
    angles = []
    for name, angles_rad in zip(("pan", "tilt"), zip(*attitudes_rad, strict=True), strict=True):
        low, high = (f"{math.degrees(end(angles_rad)):+.0f}" for end in (min, max))
        angles.append(f"{name} {low}" if low == high else f"{name} {low} to {high}")
    times = "once" if len(attitudes_rad) == 1 else f"{len(attitudes_rad)} times"
    return f"{times} at {', '.join(angles)} degrees"


def _steps(low: float, high: float, middle: float, step: float) -> list[float]:
    """Numbers a step apart, ``middle`` among them, that reach the ends."""
    below = [middle - k * step for k in range(1, math.ceil((middle - low) / step))]
    above = [middle + k * step for k in range(1, math.ceil((high - middle) / step))]
    ends = [end for end in (low, high) if abs(end - middle) > 0.3 * step]
    return [middle, *below, *above, *ends]
