"""What a bench is to reach, and its looks at a board at one placement.

The board is found, what tells most is taken of it, and it is seen that it stayed where it was.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from calib.plan.knowledge import BenchShot
from calib.plan.placements import Placement
from calib.plan.poses import AttitudeChoice, next_shot
from mastctl.bench.known import BenchKnowledge
from mastctl.bench.mast import BenchLook, BenchMast, NotThere
from mastctl.bench.reporter import BenchProgress, Reporter
from mastctl.bench.search import find_board
from mastctl.errors import MastctlError

FEWEST_LOOKS = 8
"""Of a placement: fewer leave the board's own place, and so what it tells, to chance."""


@dataclass(frozen=True)
class BenchGoal:
    """What a run is to reach, and when it stops trying.

    ``pointing_px``: rms per axis of a first pointing that the calibration may leave, on paper;
    ``pictures`` of a camera, at most, the check's among them; fewest and most ``placements``; ``checks`` that
    are not fitted.
    """

    pointing_px: float = 0.2
    pictures: int = 60
    placements: tuple[int, int] = (2, 4)
    checks: int = 5

    def at_least_px(self, counts_px: float) -> float:
        """Return what the calibration may leave: as requested, or what counts leave anyway."""
        return max(self.pointing_px, counts_px)


LITTLE_GAIN, LAST_GAIN = 0.12, 0.01
"""A look that promises less than this part of the predicted error is not worth its time at a placement, or at
the last one that there may be."""

MOVED_PX = 1.0
"""Corners further off than this at one and the same attitude, on the median, say that something moved."""

UNSEEN_IN_A_ROW = 4
"""Looks in a row without the board where it was expected: it was taken away, or has moved."""


class BoardLost(MastctlError):
    """The board is not where it was."""

    code = "board_lost"


class Looks:
    """Looks at boards through a head's cameras, of which ``known`` learns."""

    def __init__(self, mast: BenchMast, known: BenchKnowledge, reporter: Reporter, wanted: BenchGoal) -> None:
        self._mast, self._known, self._reporter, self._wanted = mast, known, reporter, wanted
        self.here = ""
        """The placement that was worked at, and whose board so stands there."""

    def find(self, name: str, placement: Placement) -> None:
        """Look for a board that was placed anew. Raises BoardNotFound."""
        self._reporter.step("search")
        known = self._known
        known.take(name, find_board(self._mast, known.now, known.sought, self._reporter, placement))

    def work_at(self, name: str, most: int) -> None:
        """Take what tells most of a board that was found, ``most`` looks or until others tell more.

        Raises BoardLost if it is not there any more.
        """
        known, self.here = self._known, name
        self._reporter.step("pictures")
        in_vain: list[tuple[float, float]] = []
        missed = 0
        while True:
            here = len(known.of(name))
            known.collect()
            ahead = max(FEWEST_LOOKS - here, 1)
            choice = next_shot(known.now, known.sought, known.shots, name, known.aim, in_vain, ahead)
            if choice is None or here >= most or self._suffices(here, choice):
                break
            self._report(name, choice)
            shot = choice.shot
            look = self.look_at(shot)
            if look is not None and look.found:
                missed = 0
                known.take(name, look)
                continue
            in_vain.append((shot.pan_rad, shot.tilt_rad))
            if look is None:
                continue
            missed += 1
            self._reporter.say(f"the board is not seen here: {_whys(look)}")
            if missed >= UNSEEN_IN_A_ROW:
                raise BoardLost(
                    f"the board of placement {name} was not seen in {missed} looks in a row where it stood "
                    f"({_whys(look)}). Put it back or place it anew, and start the same command again"
                )
        for shot in known.round_others(name):
            if known.pictures() < self._wanted.pictures - self._wanted.checks:
                look = self.look_at(shot)
                if look is not None and look.found:
                    known.take(name, look)
        self._end(name)

    def look_at(self, shot: BenchShot, check: bool = False) -> BenchLook | None:
        """Take a shot; None where the head must not go."""
        try:
            return self._look(shot, self._known.cameras_for(shot, check))
        except NotThere as reason:
            self._reporter.say(f"not looked there: {reason}")
            return None

    def stands_still(self, name: str) -> bool:
        """Return whether the last attitude of a placement shows now what it showed then."""
        then = self._known.of(name)[-1]
        apart_px = corners_apart_px(then, self._again(then))
        return apart_px is not None and apart_px <= MOVED_PX

    def _again(self, then: BenchLook) -> BenchLook:
        """A look taken again, by the cameras that showed the board and those that point."""
        return self._look(then, {*self._known.workspace.cameras, *(one.camera for one in then.found)})

    def _look(self, where: BenchShot | BenchLook, cameras: Collection[str]) -> BenchLook:
        at = where.pan_rad, where.tilt_rad, (where.pan_approach, where.tilt_approach)
        every = len(cameras) == len(self._known.head.rig.cameras)
        return self._mast.look(*at) if every else self._mast.look(*at, cameras)

    def _suffices(self, here: int, choice: AttitudeChoice) -> bool:
        if here < FEWEST_LOOKS:
            return False
        now_px = self._known.predicted_px()
        if (
            now_px <= 0.7 * self._wanted.at_least_px(self._known.counts_px)
            and self._known.fitted_looks >= here
        ):
            return True
        last = len(self._known.placements()) >= self._wanted.placements[1]
        return choice.expected_px > (1.0 - (LAST_GAIN if last else LITTLE_GAIN)) * now_px

    def _end(self, name: str) -> None:
        """Look once more where the placement began: did the board, or the head, stay as it was?"""
        then = self._known.of(name)[0]
        now = self._again(then)
        apart_px = corners_apart_px(then, now)
        if apart_px is not None and apart_px > self._allowed_px():
            self._reporter.say(
                f"placement {name}: its first picture taken again shows the board {apart_px:.1f} px aside: "
                "the board or the head moved meanwhile; the fit will show which, and when"
            )
            self._known.kept.note(event="moved", name=name, apart_px=round(apart_px, 2))
            self._known.take(name, now)  # one more picture of how it is now
        self._known.kept.note(event="done", name=name)

    def _allowed_px(self) -> float:
        """How far one attitude may show a board aside: what two readings may differ by, and more."""
        head = self._known.head
        camera = head.rig.cameras[self._known.workspace.cameras[0]].model
        return MOVED_PX + 3.0 * head.count_rad * float(np.linalg.norm(camera.H))

    def _report(self, name: str, choice: AttitudeChoice) -> None:
        known = self._known
        self._reporter.progress(
            BenchProgress(
                name,
                known.pictures(),
                self._wanted.pictures,
                known.predicted_px(),
                self._wanted.at_least_px(known.counts_px),
                known.counts_px,
                (choice.shot.pan_rad, choice.shot.tilt_rad),
                choice.expected_px,
                known.cells(),
            )
        )


def corners_apart_px(then: BenchLook, now: BenchLook) -> float | None:
    """Return how far corners lie apart in two looks from one attitude, median; None if none is common."""
    apart: list[float] = []
    before = {one.camera: one.corners for one in then.found}
    for one in now.found:
        old = before.get(one.camera)
        if old is None or one.corners is None:
            continue
        _, a, b = np.intersect1d(old.ids, one.corners.ids, return_indices=True)
        apart += np.linalg.norm(old.pixels_px[a] - one.corners.pixels_px[b], axis=1).tolist()
    return float(np.median(apart)) if apart else None


def deg(angle_rad: float) -> str:
    """Return an angle as a person reads it."""
    return f"{math.degrees(angle_rad):+.0f} degrees"


def _whys(look: BenchLook) -> str:
    """Why a look does not show the board, camera by camera."""
    return "; ".join(dict.fromkeys(one.why for one in look.seen if one.why)) or "no corners found"
