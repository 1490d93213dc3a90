"""The search for a board: first where it should stand, then ever further around it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator

import numpy as np

from calib.errors import CalibError, Unreachable
from calib.geometry.rig import Rig
from calib.plan.knowledge import Knowledge
from calib.plan.placements import Placement
from calib.plan.poses import Sought, readings
from mastctl.bench.mast import BenchInterrupted, BenchLook, BenchMast, NoLight, NotThere

OVERLAP = 0.7
"""Of a picture's view: how far apart the looks of a search are."""

ANOTHER = ("another board", "mirrored", "two boards")
"""What `calib.targets.corners` says of a board in view that is not the one that is looked for."""

MOST_LOOKS = 100
"""A narrow view would take hundreds, a quarter of an hour: the operator is consulted before."""

LOOKS_BESIDE = 8
"""Looks after such a one: the right board may hang beside it."""

MOST_KINDS = 4
"""So many things that were seen instead are reported, the most frequent."""

_NUMBERS = re.compile(r"[-+]?[0-9][0-9.]*")


def find_board(
    mast: BenchMast, known: Knowledge, sought: Sought, say: Callable[[str], None], placement: Placement
) -> BenchLook:
    """Return the first look that shows the board: where it should stand, then ever further around it.

    Views without light or with nothing in them end nothing: the board may stand beside them. Raises
    BenchInterrupted ``board_not_found`` with what the images showed instead, and where.
    """
    on_head = {name for name, camera in known.rig.cameras.items() if camera.on == "head"}
    attitudes = list(_attitudes(known.rig, sought, placement))
    instead: dict[str, tuple[str, list[str]]] = {}
    looks = other_at = 0
    everywhere = " all over the head's limits"
    for at_rad in attitudes:
        try:
            look = mast.look(*at_rad)
        except NotThere as error:
            _note(instead, str(error), at_rad)
            continue
        except NoLight as error:
            reasons = [str(error).partition("; ")[0]]
        else:
            if any(one.camera in on_head for one in look.found):
                return look
            reasons = [one.why for one in look.seen if one.why]
        looks += 1
        for reason in dict.fromkeys(reasons):
            _note(instead, reason, at_rad)
        if not other_at and any(map(_is_another, reasons)):
            other_at = looks
        if looks == 1:
            most = min(len(attitudes), MOST_LOOKS) - 1
            say(
                f"the board is not where it was requested ({_summary(instead)}); looking around, {most} "
                "looks at most"
            )
        another = other_at and looks >= other_at + LOOKS_BESIDE
        if another or looks == MOST_LOOKS:
            everywhere = "" if another else " around where it was requested"
            break
    count = "1 look" if looks == 1 else f"{looks} looks"
    raise BenchInterrupted(
        f"the board was not found in {count}{everywhere} ({_summary(instead)}); place it as "
        "requested, in the light, facing the head, and start the same command again",
        "board_not_found",
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


def _note(instead: dict[str, tuple[str, list[str]]], reason: str, at_rad: tuple[float, float]) -> None:
    """Keep why an attitude shows no board; the same reason with other numbers is the same."""
    pan, tilt = map(math.degrees, at_rad)
    instead.setdefault(_NUMBERS.sub("", reason), (reason, []))[1].append(f"pan {pan:+.0f}, tilt {tilt:+.0f}")


def _summary(instead: dict[str, tuple[str, list[str]]]) -> str:
    """What was seen, how often and where first: another board first, then what most views showed."""
    if not instead:
        return "no corners were found"
    found = sorted(instead.values(), key=lambda one: (not _is_another(one[0]), -len(one[1])))
    more = [f"{len(found) - MOST_KINDS} other reasons"] if len(found) > MOST_KINDS else []
    times = [
        f"{reason}, once at {places[0]} degrees"
        if len(places) == 1
        else f"{reason}, {len(places)} times, first at {places[0]} degrees"
        for reason, places in found[:MOST_KINDS]
    ]
    return "; ".join([*times, *more])


def _is_another(reason: str) -> bool:
    return any(part in reason for part in ANOTHER)


def _steps(low: float, high: float, middle: float, step: float) -> list[float]:
    """Numbers a step apart, ``middle`` among them, that reach the ends."""
    below = [middle - k * step for k in range(1, math.ceil((middle - low) / step))]
    above = [middle + k * step for k in range(1, math.ceil((high - middle) / step))]
    ends = [end for end in (low, high) if abs(end - middle) > 0.3 * step]
    return [middle, *below, *above, *ends]
