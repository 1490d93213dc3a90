"""Looking for a board: first where it should stand, then ever further around it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

import numpy as np

from calib.bench.knowledge import Knowledge
from calib.bench.placements import Placement
from calib.bench.poses import Sought, readings
from calib.errors import CalibError, Unreachable
from mastctl.bench.eyes import Eyes, Look, NotThere
from mastctl.bench.teller import Teller
from mastctl.errors import MastctlError

OVERLAP = 0.7
"""Of a picture's view: how far apart the looks of a search are."""

MOST_LOOKS = 120

TELLING = ("another board", "mirrored", "two boards")
"""What `calib.corners` says of a board in view that is not the one that is looked for."""

LOOKS_BESIDE = 8
"""Looks after such a one: the right board may hang beside it."""

SPOILED = ("too dark", "too bright", "next to nothing", "is blurred", "during its exposure")
SPOILED_LOOKS, MOSTLY = 24, 0.9
"""If so many looks, and so large a part of them, were no good, no other will be."""

_NUMBERS = re.compile(r"[-+]?[0-9][0-9.]*")


class BoardNotFound(MastctlError):
    """No look within the limits showed the board."""

    code = "board_not_found"


class Search:
    """Looks for the board within the head's limits."""

    def __init__(self, eyes: Eyes, known: Knowledge, sought: Sought, teller: Teller) -> None:
        self._eyes, self._known, self._sought, self._teller = eyes, known, sought, teller
        self._on_head = {name for name, camera in known.rig.cameras.items() if camera.on == "head"}

    def find(self, placement: Placement) -> Look:
        """Return the first look that shows the board.

        Raises
        ------
        BoardNotFound
            With what the pictures showed instead.
        """
        whys = _Whys()
        for pan_rad, tilt_rad in self._attitudes(placement):
            try:
                look = self._eyes.look(pan_rad, tilt_rad)
            except NotThere as reason:
                whys.refused(str(reason))
                continue
            if any(one.camera in self._on_head for one in look.found):
                return look
            whys.add(look)
            if whys.looks == 1:
                self._teller.say("the board is not where it was asked for; looking around")
            if whys.decided or whys.looks >= MOST_LOOKS:
                break
        everywhere = "" if whys.decided else " all over the head's limits"
        count = "1 look" if whys.looks == 1 else f"{whys.looks} looks"
        raise BoardNotFound(
            f"the board was not found in {count}{everywhere} ({whys.shown}); place it as "
            "asked, in the light, facing the head, and start the same command again"
        )

    def _attitudes(self, placement: Placement) -> Iterator[tuple[float, float]]:
        """Where the board should be, then a grid of the limits from there outwards."""
        low, high = zip(self._sought.pan_limits_rad, self._sought.tilt_limits_rad, strict=True)
        pan_rad, tilt_rad = self._towards(placement)
        yield pan_rad, tilt_rad
        model = next(c.model for c in self._known.rig.cameras.values() if c.on == "head")
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

    def _towards(self, placement: Placement) -> tuple[float, float]:
        """The readings that bring the middle of a board so placed into the middle of the picture."""
        rig = self._known.rig
        middle = placement.rover_from_board(rig.mast.rover_from_head(0.0, 0.0)).translation_m
        model = next(c.model for c in rig.cameras.values() if c.on == "head")
        limits = self._sought.pan_limits_rad, self._sought.tilt_limits_rad
        try:
            return readings(rig, self._sought, model, middle)
        except (Unreachable, CalibError, ValueError):
            pan, tilt = math.radians(placement.bearing_deg), math.radians(placement.height_deg)
            return min(max(pan, limits[0][0]), limits[0][1]), min(max(tilt, limits[1][0]), limits[1][1])


class _Whys:
    """What looks showed instead of the board."""

    def __init__(self) -> None:
        self.looks = 0
        self._counts: dict[str, int] = {}
        self._told: dict[str, str] = {}
        self._first_telling = 0

    def refused(self, reason: str) -> None:
        """Count an attitude that the head does not turn to."""
        self._count(reason)

    def add(self, look: Look) -> None:
        """Count a look; the same thing with other numbers is the same."""
        self.looks += 1
        whys = {_NUMBERS.sub("", one.why): one.why for one in look.seen if one.why}
        for why in whys.values():
            self._count(why)
        if not self._first_telling and any(_has(why, TELLING) for why in whys):
            self._first_telling = self.looks

    @property
    def decided(self) -> bool:
        """Whether looking further shows nothing else: another board is there, or pictures are no good."""
        if self._first_telling and self.looks >= self._first_telling + LOOKS_BESIDE:
            return True
        spoiled = sum(count for why, count in self._counts.items() if _has(why, SPOILED))
        return self.looks >= SPOILED_LOOKS and spoiled >= MOSTLY * self.looks

    @property
    def shown(self) -> str:
        """The sentence that tells most."""
        if not self._counts:
            return "no corners were found"
        most = max(self._counts, key=lambda why: (_has(why, TELLING), self._counts[why]))
        return self._told[most]

    def _count(self, why: str) -> None:
        kind = _NUMBERS.sub("", why)
        self._counts[kind] = self._counts.get(kind, 0) + 1
        self._told.setdefault(kind, why)


def _has(why: str, words: tuple[str, ...]) -> bool:
    return any(word in why for word in words)


def _steps(low: float, high: float, middle: float, step: float) -> list[float]:
    """Numbers a step apart, ``middle`` among them, that reach the ends."""
    below = [middle - k * step for k in range(1, math.ceil((middle - low) / step))]
    above = [middle + k * step for k in range(1, math.ceil((high - middle) / step))]
    ends = [end for end in (low, high) if abs(end - middle) > 0.3 * step]
    return [middle, *below, *above, *ends]
