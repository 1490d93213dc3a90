"""Looking for a board: first where it should stand, then ever further around it."""

from __future__ import annotations

import math
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


class BoardNotFound(MastctlError):
    """No look within the limits showed the board."""

    code = "board_not_found"


class Search:
    """Looks for the board within the head's limits."""

    def __init__(self, eyes: Eyes, known: Knowledge, sought: Sought, teller: Teller) -> None:
        self._eyes, self._known, self._sought, self._teller = eyes, known, sought, teller

    def find(self, placement: Placement) -> Look:
        """Return the first look that shows the board.

        Raises
        ------
        BoardNotFound
            With what the pictures showed instead.
        """
        whys: dict[str, int] = {}
        looks = 0
        for pan_rad, tilt_rad in self._attitudes(placement):
            try:
                look = self._eyes.look(pan_rad, tilt_rad)
            except NotThere as reason:
                whys[str(reason)] = whys.get(str(reason), 0) + 1
                continue
            if look.found:
                return look
            looks += 1
            for one in look.seen:
                if one.why:
                    whys[one.why] = whys.get(one.why, 0) + 1
            if looks == 1:
                self._teller.say("the board is not where it was asked for; looking around")
            if looks >= MOST_LOOKS:
                break
        shown = max(whys, key=lambda why: whys[why], default="no corners were found")
        raise BoardNotFound(
            f"the board was not found in {looks} looks all over the head's limits ({shown}); place it as "
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


def _steps(low: float, high: float, middle: float, step: float) -> list[float]:
    """Numbers a step apart, ``middle`` among them, that reach the ends."""
    below = [middle - k * step for k in range(1, math.ceil((middle - low) / step))]
    above = [middle + k * step for k in range(1, math.ceil((high - middle) / step))]
    ends = [end for end in (low, high) if abs(end - middle) > 0.3 * step]
    return [middle, *below, *above, *ends]
