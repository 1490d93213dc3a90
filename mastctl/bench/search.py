"""Looking for a board: first where it should stand, then ever further around it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence

import numpy as np

from calib.errors import CalibError, Unreachable
from calib.plan.knowledge import Knowledge
from calib.plan.placements import Placement
from calib.plan.poses import Sought, readings
from mastctl.bench.eyes import BenchEyes, BenchLook, NoLight, NotThere
from mastctl.bench.reporter import Reporter
from mastctl.errors import MastctlError

OVERLAP = 0.7
"""Of a picture's view: how far apart the looks of a search are."""

TELLING = ("another board", "mirrored", "two boards")
"""What `calib.targets.corners` says of a board in view that is not the one that is looked for."""

MOST_LOOKS = 100
"""A narrow view would take hundreds, a quarter of an hour: whoever put the board up is asked again before."""

LOOKS_BESIDE = 8
"""Looks after such a one: the right board may hang beside it."""

MOST_KINDS = 4
"""So many things that were seen instead are told, the most frequent."""

_NUMBERS = re.compile(r"[-+]?[0-9][0-9.]*")


class BoardNotFound(MastctlError):
    """No look within the limits showed the board."""

    code = "board_not_found"


class BoardSearch:
    """Looks for the board within the head's limits."""

    def __init__(self, eyes: BenchEyes, known: Knowledge, sought: Sought, reporter: Reporter) -> None:
        self._eyes, self._known, self._sought, self._reporter = eyes, known, sought, reporter
        self._on_head = {name for name, camera in known.rig.cameras.items() if camera.on == "head"}

    def find(self, placement: Placement) -> BenchLook:
        """Return the first look that shows the board.

        Views without light or with nothing in them end nothing: the board may stand beside them.

        Raises
        ------
        BoardNotFound
            With what the pictures showed instead, and where.
        """
        attitudes = list(self._attitudes(placement))
        instead = _Instead()
        for at_rad in attitudes:
            try:
                look = self._eyes.look(*at_rad)
            except NotThere as reason:
                instead.keep(str(reason), at_rad)
                continue
            except NoLight as reason:
                instead.looked([str(reason).partition("; ")[0]], at_rad)
            else:
                if any(one.camera in self._on_head for one in look.found):
                    return look
                instead.looked([one.why for one in look.seen if one.why], at_rad)
            if instead.looks == 1:
                most = min(len(attitudes), MOST_LOOKS) - 1
                words = f"({instead.told}); looking around, {most} looks at most"
                self._reporter.say(f"the board is not where it was asked for {words}")
            if instead.another_board or instead.looks == MOST_LOOKS:
                everywhere = "" if instead.another_board else " around where it was asked for"
                break
        else:
            everywhere = " all over the head's limits"
        raise BoardNotFound(
            f"the board was not found in {_counted(instead.looks)}{everywhere} ({instead.told}); place it as "
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


class _Instead:
    """What looks showed instead of the board, and where."""

    def __init__(self) -> None:
        self.looks = 0
        self._first_other = 0
        self._told: dict[str, str] = {}
        self._where: dict[str, list[tuple[float, float]]] = {}

    def keep(self, reason: str, at_rad: tuple[float, float]) -> None:
        """Keep why an attitude showed no board."""
        kind = _NUMBERS.sub("", reason)  # the same thing with other numbers is the same
        self._told.setdefault(kind, reason)
        self._where.setdefault(kind, []).append(at_rad)

    def looked(self, whys: Sequence[str], at_rad: tuple[float, float]) -> None:
        """Keep why a look does not show the board, camera by camera."""
        self.looks += 1
        for why in {_NUMBERS.sub("", why): why for why in whys}.values():
            self.keep(why, at_rad)
        if not self._first_other and any(_is_another(why) for why in whys):
            self._first_other = self.looks

    @property
    def another_board(self) -> bool:
        """Whether another board is there, and the right one not beside it."""
        return bool(self._first_other) and self.looks >= self._first_other + LOOKS_BESIDE

    @property
    def told(self) -> str:
        """What was seen, and where: another board first, then what most views showed."""
        if not self._where:
            return "no corners were found"
        kinds = sorted(self._where, key=lambda kind: (not _is_another(kind), -len(self._where[kind])))
        words = [f"{self._told[kind]}, {_place(self._where[kind])}" for kind in kinds[:MOST_KINDS]]
        more = len(kinds) - len(words)
        return "; ".join([*words, f"{more} other reasons"] if more else words)


def _is_another(why: str) -> bool:
    return any(words in why for words in TELLING)


def _counted(looks: int) -> str:
    return "1 look" if looks == 1 else f"{looks} looks"


def _place(attitudes_rad: Sequence[tuple[float, float]]) -> str:
    """How often, and within which angles, as a person reads it."""
    told = []
    for name, angles_rad in zip(("pan", "tilt"), zip(*attitudes_rad, strict=True), strict=True):
        low, high = (f"{math.degrees(end(angles_rad)):+.0f}" for end in (min, max))
        told.append(f"{name} {low}" if low == high else f"{name} {low} to {high}")
    times = "once" if len(attitudes_rad) == 1 else f"{len(attitudes_rad)} times"
    return f"{times} at {', '.join(told)} degrees"


def _steps(low: float, high: float, middle: float, step: float) -> list[float]:
    """Numbers a step apart, ``middle`` among them, that reach the ends."""
    below = [middle - k * step for k in range(1, math.ceil((middle - low) / step))]
    above = [middle + k * step for k in range(1, math.ceil((high - middle) / step))]
    ends = [end for end in (low, high) if abs(end - middle) > 0.3 * step]
    return [middle, *below, *above, *ends]
