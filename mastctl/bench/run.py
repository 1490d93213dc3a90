"""A bench calibration from the first look to the last: it drives the head and requests placements.

Everything that is seen is in the survey's folder before it is used, so a run that ends at any moment goes on
from there. At its end are images that are not fitted, and pointings at corners, beside what was promised.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, Protocol

import numpy as np

from calib.adjust.result import BenchCalibration
from calib.calibrate.starts.bench import SomethingChanged
from calib.errors import CalibError, Unreachable
from calib.geometry.pointing import choose, solve
from calib.geometry.rigid import FloatArray
from calib.geometry.stereo import triangulate
from calib.plan.knowledge import BenchShot
from calib.plan.placements import Advice, Placement, advise, advise_for_body, first_placement
from calib.plan.poses import AttitudeChoice, candidates, next_shot
from calib.targets.boards import Corners
from mastctl.bench.known import BenchKnowledge
from mastctl.bench.mast import BenchInterrupted, BenchLook, BenchMast, NotThere, SimulatedBoard, find_board
from mastctl.errors import MastctlError
from mastctl.report.pages import Table

FEWEST_LOOKS = 8
"""Of a placement: fewer leave the board's own place, and so the information of its images, to chance."""

LITTLE_GAIN, LAST_GAIN = 0.12, 0.01
"""A look that promises less than this part of the predicted error is not worth its time at a placement, or at
the last one that there may be."""

MOVED_PX = 1.0
"""Corners further off than this at one and the same attitude, on the median, say that something moved."""

UNSEEN_IN_A_ROW = 4
"""Looks in a row without the board where it was expected: it was taken away, or has moved."""


PLACEMENTS, CHECKS = (2, 4), 5
"""Fewest and most placements; images that are not fitted."""


class Reporter(Protocol):
    """Shows the operator how a run goes, and has the board placed."""

    def say(self, sentence: str) -> None:
        """Show a sentence."""
        ...

    def change(self, **changed: Any) -> None:
        """Show what has changed of the run (`mastctl.answers.BenchRunRecord`)."""
        ...

    def place(self, name: str, placement: Placement) -> None:
        """Request a placement, and return when the board stands there."""
        ...


POINTINGS = 4


@dataclass(frozen=True)
class CornerPointing:
    """A first pointing at a corner that was clicked off the middle.

    ``residual_px`` is where the corner came to lie in the new image, less where it was to lie;
    ``promised_px`` one sigma of either number.
    """

    corner: int
    range_m: float
    turned_deg: float
    residual_px: tuple[float, float]
    promised_px: float


@dataclass(frozen=True, eq=False)
class Checked:
    """The result of a check.

    ``promised_px``: camera to what the fit promised of corners in images that were not fitted, rms per axis.
    """

    promised_px: Mapping[str, float]
    pointings: tuple[CornerPointing, ...]

    @property
    def pointing_rms_px(self) -> tuple[float, float] | None:
        """Rms (x, y) of the pointings."""
        if not self.pointings:
            return None
        x, y = np.sqrt(np.mean([np.square(one.residual_px) for one in self.pointings], axis=0))
        return float(x), float(y)

    @property
    def pointing_promised_px(self) -> float | None:
        """Rms of what was promised of them."""
        squares = [one.promised_px**2 for one in self.pointings]
        return math.sqrt(np.mean(squares)) if squares else None

    def table(self) -> Table | None:
        """Return the pointings for a page."""
        rows = [
            [
                f"{one.corner}",
                f"{one.range_m:.2f}",
                f"{one.turned_deg:.0f}",
                *(f"{part:+.3f}" for part in one.residual_px),
                f"{one.promised_px:.3f}",
            ]
            for one in self.pointings
        ]
        headings = ("corner", "range m", "turned deg", "residual x px", "y px", "promised sigma px")
        return Table(headings, rows) if rows else None


class BenchRun:
    """One run; `run` returns when nothing more is wanted.

    ``known`` is all that was seen, and what follows from it; ``wanted_px`` the rms per axis of a first
    pointing that the calibration may leave, on paper; ``most`` pictures of a camera, the check's among them;
    ``simulated`` the board of a simulated rover.
    """

    def __init__(
        self,
        mast: BenchMast,
        known: BenchKnowledge,
        reporter: Reporter,
        wanted_px: float = 0.2,
        most: int = 60,
        simulated: SimulatedBoard | None = None,
    ) -> None:
        self.known, self._mast, self._reporter, self._simulated = known, mast, reporter, simulated
        self._wanted_px, self._most = wanted_px, most
        self._current = ""
        """The placement that was worked at, and whose board so stands in place."""

    def run(self) -> BenchCalibration:
        """Take pictures until they suffice, and return the fit of all of them.

        Raises MastctlError if the head or the cameras fail, the board is not found, or it is stopped: what
        was seen is in the folder. Raises CalibError if what was seen cannot be fitted; at the end of a
        placement already if something changed that no more pictures mend.
        """
        known = self.known
        self._take_up()
        while not self._enough():
            name, placement = self._next_placement()
            self._reporter.place(name, placement)
            if self._simulated is not None:
                self._simulated.stand(placement)
            known.take(name, find_board(self._mast, known.now, known.sought, self._reporter.say, placement))
            self._work_at(name)
        return known.fit()

    def check(self) -> Checked:
        """Capture images that are not fitted, and point at corners, where the board stands now.

        Raises MastctlError as `run`.
        """
        known, name = self.known, self.known.placements()[-1]
        self._reporter.change(step="check")
        if self._current != name and not self._stands_still(name):
            self._reporter.say(f"not checked: the board does not stand any more as in placement {name}")
            return Checked({}, ())
        for shot in self._unvisited(name, CHECKS - sum(1 for _, check, _ in known.looks if check)):
            pan_deg, tilt_deg = math.degrees(shot.pan_rad), math.degrees(shot.tilt_rad)
            self._reporter.say(
                f"an image that is not fitted, at pan {pan_deg:+.0f}, tilt {tilt_deg:+.0f} degrees"
            )
            look = self.look_at(shot)
            if look is not None and look.found:
                known.take(name, look, check=True)
        looks = known.of(name, check=True)
        pointings = tuple(islice(self._pointings(name, looks), POINTINGS))
        self._reporter.change(step="fit")
        return Checked(known.promised_px(looks, name), pointings)

    def _unvisited(self, name: str, count: int) -> Iterator[BenchShot]:
        """Attitudes that show the board, each as far as can be from all that were taken or yielded."""
        known = self.known
        mine = [shot for shot in known.shots if shot.placement == name]
        every = list(candidates(known.now, known.sought, mine, name))
        taken = [(shot.pan_rad, shot.tilt_rad) for shot in mine]
        for _ in range(min(count, len(every))):
            far = [min((math.dist((s.pan_rad, s.tilt_rad), at) for at in taken), default=9.0) for s in every]
            shot = every.pop(int(np.argmax(far)))
            taken.append((shot.pan_rad, shot.tilt_rad))
            yield shot

    def _pointings(self, name: str, clicked: Sequence[BenchLook]) -> Iterator[CornerPointing]:
        """Pointings at corners that former looks show off the middle, one of each look, and once more."""
        rng, cameras = np.random.default_rng(len(clicked)), self.known.workspace.cameras
        for look in [*clicked, *clicked]:
            if not set(cameras) <= set(look.corners):
                continue
            common = np.array(sorted(set.intersection(*(set(look.corners[c].ids.tolist()) for c in cameras))))
            rng.shuffle(common)
            tried = (self._pointing(name, look, int(corner)) for corner in common[:2])
            pointing = next((one for one in tried if one is not None), None)
            if pointing is not None:
                x, y = pointing.residual_px
                self._reporter.say(
                    f"pointed at corner {pointing.corner}, {pointing.turned_deg:.0f} degrees off: residual "
                    f"{x:+.2f}, {y:+.2f} px (promised {pointing.promised_px:.2f})"
                )
                yield pointing

    def _pointing(self, name: str, look: BenchLook, corner: int) -> CornerPointing | None:
        """Bring one corner to the middle of the first camera's image; None where that cannot be tried."""
        known, head = self.known, self._mast.head
        rig, cameras = known.now.rig, known.workspace.cameras
        now_rad = rig.joints.true_rad((look.pan_rad, look.tilt_rad), (look.pan_approach, look.tilt_approach))
        models = [rig.camera_in_rover(name, *now_rad) for name in cameras]
        pixels = [_pixel(look.corners[name], corner) for name in cameras]
        model = rig.cameras[cameras[0]].model
        try:
            if len(cameras) > 1:
                point = triangulate(models[0], models[1], pixels[0], pixels[1]).position_m
            else:  # one camera gets the range: how far the corner is by the fit
                ray = models[0].ray(pixels[0])
                (by_fit_m,) = known.now.boards[name].points(known.board.in_board_m(np.array([corner])))
                point = ray.origins_m + ray.directions * float(np.linalg.norm(by_fit_m - ray.origins_m))
            found = solve(rig.mast, model, point, from_pan_rad=now_rad[0], from_tilt_rad=now_rad[1])
            angles = choose(
                found, head.pan_limits_rad, head.tilt_limits_rad, look.pan_rad, look.tilt_rad,
                read=lambda one: rig.joints.read_rad((one.pan_rad, one.tilt_rad)),
            )  # fmt: skip
            turn_rad = angles.pan_rad - now_rad[0], angles.tilt_rad - now_rad[1]
            sides = (0, 0) if head.one_sided else (1 if turn_rad[0] > 0 else -1, 1 if turn_rad[1] > 0 else -1)
            landed = self._mast.look(*rig.joints.read_rad((angles.pan_rad, angles.tilt_rad), sides), sides)
        except (Unreachable, CalibError, NotThere):
            return None
        again = landed.corners.get(cameras[0])
        if again is None or corner not in again.ids:
            return None
        x, y = _pixel(again, corner) - np.asarray(model.image_center_px)
        promised_px = math.hypot(known.predicted_px(), known.counts_px, 2.0**0.5 * known.sought.sigma_px)
        range_m, turned_deg = np.linalg.norm(point - models[0].C), math.degrees(math.hypot(*turn_rad))
        return CornerPointing(corner, float(range_m), turned_deg, (float(x), float(y)), promised_px)

    def _take_up(self) -> None:
        """Go on where the folder's last run ended."""
        known = self.known
        if not known.looks:
            return
        self._reporter.say(
            f"going on with {known.folder.path}: {known.pictures()} pictures a camera are there"
        )
        self._reporter.change(step="fit")
        known.believe_boards()
        known.try_fit()
        self._reporter.change(**known.progress(self._target_px()))
        name = known.placements()[-1]
        if self._stands_still(name):
            self._reporter.say(f"the board stands as it stood in placement {name}")
            self._work_at(name)
        else:
            self._reporter.say(f"the board does not stand any more as in placement {name}")

    def _enough(self) -> bool:
        known, placements = self.known, len(self.known.placements())
        if placements >= PLACEMENTS[1] or self._looks_left() <= 0:
            return True
        if not placements:
            return False
        try:
            known.fit()
        except SomethingChanged:
            raise  # no other placement mends it
        except CalibError as reason:
            self._reporter.say(f"no fit yet: {reason}")
        if placements < PLACEMENTS[0] or self._body_advice() is not None:
            return False
        return known.predicted_px() <= self._target_px()

    def _body_advice(self) -> Advice | None:
        """Where the board would tie body cameras to the head that are not tied yet."""
        known, untied = self.known, self.known.untied()
        return advise_for_body(known.now, known.sought, known.shots, untied) if untied else None

    def _looks_left(self) -> int:
        """Looks that may still be taken for the fit."""
        return self._most - CHECKS - self.known.pictures()

    def _target_px(self) -> float:
        """What the calibration may leave: as requested, or what counts leave anyway."""
        return max(self._wanted_px, self.known.counts_px)

    def _next_placement(self) -> tuple[str, Placement]:
        known, name = self.known, f"p{len(self.known.placements()) + 1}"
        if not known.shots:
            return name, first_placement(known.now, known.sought)
        advice = self._body_advice() or advise(known.now, known.sought, known.shots, known.aim)
        if advice is None:
            raise MastctlError("no place for the board can be seen within the head's limits")
        return name, advice.placement

    def _work_at(self, name: str) -> None:
        """Take the most informative images of a board that was found, until others would add more.

        Some are left for the other placements. Raises BenchInterrupted ``board_lost``.
        """
        known, self._current = self.known, name
        left = max(PLACEMENTS[0] + 1 - len(known.placements()), 1)
        most = max(FEWEST_LOOKS, self._looks_left() // left)
        self._reporter.change(step="pictures")
        in_vain: list[tuple[float, float]] = []
        missed = 0
        while True:
            taken = len(known.of(name))
            ahead = max(FEWEST_LOOKS - taken, 1)
            choice = next_shot(known.now, known.sought, known.shots, name, known.aim, in_vain, ahead)
            if choice is None or taken >= most or self._suffices(taken, choice):
                break
            self._reporter.change(**known.progress(self._target_px(), choice))
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
            reason = "; ".join(dict.fromkeys(one.why for one in look.seen if one.why)) or "no corners found"
            self._reporter.say(f"the board is not seen here: {reason}")
            if missed >= UNSEEN_IN_A_ROW:
                raise BenchInterrupted(
                    f"the board of placement {name} was not seen in {missed} looks in a row where it stood "
                    f"({reason}). Put it back or place it anew, and go on with the run",
                    "board_lost",
                )
        for shot in known.round_others(name):
            if self._looks_left() > 0:
                look = self.look_at(shot)
                if look is not None and look.found:
                    known.take(name, look)
        # Once more where the placement began: the fit shows whether board and head stayed there.
        again = self._again(known.of(name)[0])
        if again.found:
            known.take(name, again)

    def look_at(self, shot: BenchShot) -> BenchLook | None:
        """Take a shot; None where the head must not go."""
        approach, cameras = (shot.pan_approach, shot.tilt_approach), self.known.cameras_for(shot.placement)
        try:
            return self._mast.look(shot.pan_rad, shot.tilt_rad, approach, cameras)
        except NotThere as reason:
            self._reporter.say(f"no image was taken there: {reason}")
            return None

    def _again(self, then: BenchLook) -> BenchLook:
        return self._mast.look(then.pan_rad, then.tilt_rad, (then.pan_approach, then.tilt_approach))

    def _stands_still(self, name: str) -> bool:
        """Whether the last attitude of a placement shows now what it showed then."""
        then = self.known.of(name)[-1]
        apart_px = corners_apart_px(then, self._again(then))
        return apart_px is not None and apart_px <= MOVED_PX

    def _suffices(self, taken: int, choice: AttitudeChoice) -> bool:
        if taken < FEWEST_LOOKS:
            return False
        known = self.known
        now_px = known.predicted_px()
        if now_px <= 0.7 * self._target_px() and known.fitted_looks >= taken:
            return True
        last = len(known.placements()) >= PLACEMENTS[1]
        return choice.expected_px > (1.0 - (LAST_GAIN if last else LITTLE_GAIN)) * now_px


def corners_apart_px(then: BenchLook, now: BenchLook) -> float | None:
    """Return how far corners lie apart in two looks from one attitude, median; None if none is common."""
    before, after = then.corners, now.corners
    apart: list[float] = []
    for camera in before.keys() & after.keys():
        old, new = before[camera], after[camera]
        _, a, b = np.intersect1d(old.ids, new.ids, return_indices=True)
        apart += np.linalg.norm(old.pixels_px[a] - new.pixels_px[b], axis=1).tolist()
    return float(np.median(apart)) if apart else None


def _pixel(corners: Corners, corner: int) -> FloatArray:
    return np.asarray(corners.pixels_px[int(np.flatnonzero(corners.ids == corner)[0])])
