"""A bench calibration from the first look to the last: it drives the head and asks for placements.

Everything that is seen is in the survey's folder before anything is made of it, so a run that ends at any
moment goes on from there.
"""

from __future__ import annotations

import math
import time
from dataclasses import asdict, replace

from calib.calibrate.starts.bench import SomethingChanged
from calib.errors import CalibError
from calib.plan.placements import Advice, Placement, advise, advise_for_body, first_placement
from calib.plan.poses import next_shot
from calib.targets.boards import AnyBoard
from mastctl.bench.eyes import Eyes
from mastctl.bench.final import Checked, point_at_corners, unvisited
from mastctl.bench.fitting import FitSurvey, Fitted
from mastctl.bench.folder import Kept
from mastctl.bench.known import Known
from mastctl.bench.looks import Looks, deg
from mastctl.bench.teller import Teller
from mastctl.bench.wanted import FEWEST_LOOKS, Wanted
from mastctl.errors import MastctlError


class BenchRun:
    """One run; `run` returns when nothing more is wanted.

    Parameters
    ----------
    eyes
        The head and its cameras.
    kept
        The survey's folder and the run's journal.
    board_name, board
        What is looked for.
    teller
        Who places the board, and is told how it goes.
    fit
        Makes a rig of the survey.
    wanted
        What to reach.

    Attributes
    ----------
    known
        All that was seen and follows from it.
    """

    def __init__(
        self,
        eyes: Eyes,
        kept: Kept,
        board_name: str,
        board: AnyBoard,
        teller: Teller,
        fit: FitSurvey,
        wanted: Wanted,
    ) -> None:
        self.wanted, self._eyes, self._teller, self._kept = wanted, eyes, teller, kept
        self.known = Known(eyes.head, kept, board_name, board, fit, teller.say)
        self._looks = Looks(eyes, self.known, teller, wanted)

    def run(self) -> Fitted:
        """Take pictures until they suffice, and return the fit of all of them.

        Raises
        ------
        MastctlError
            If the head or the cameras fail, the board is not found, or somebody stops it. What was seen is in
            the folder.
        CalibError
            If what was seen cannot be fitted; at the end of a placement already if something changed that no
            more pictures mend.
        """
        try:
            self._take_up()
            while not self._enough():
                name, placement = self._next_placement()
                self._teller.place(name, placement, self._eyes.head)
                self._kept.note(event="placement", name=name, asked=asdict(placement))
                self._looks.find(name, placement)
                self._looks.work_at(name, self._share())
            return self.known.fit()
        finally:
            self.known.end()

    def choice_s(self) -> float:
        """Return how long it takes to choose a look in the middle of a placement's first ones, seconds."""
        now, sought = self.known.now, self.known.sought
        pose = first_placement(now, sought).rover_from_board(now.rig.mast.rover_from_head(0.0, 0.0))
        stands = replace(now, boards={**now.boards, "": pose})
        begun_s = time.monotonic()
        next_shot(stands, sought, self.known.shots, "", self.known.aim, ahead=FEWEST_LOOKS // 2)
        return time.monotonic() - begun_s

    def check(self) -> Checked:
        """Look where nothing was fitted, and point at corners, where the board stands now.

        Raises
        ------
        MastctlError
            As `run`.
        """
        known, name = self.known, self.known.placements()[-1]
        if self._looks.here != name and not self._looks.stands_still(name):
            self._teller.say(f"not checked: the board does not stand any more as in placement {name}")
            return Checked({}, ())
        left = self.wanted.checks - sum(1 for _, check, _ in known.looks if check)
        here = [shot for shot in known.shots if shot.placement == name]
        for shot in unvisited(known.now, known.sought, here, name, left):
            self._teller.say(
                f"a picture that is not fitted, at pan {deg(shot.pan_rad)}, tilt {deg(shot.tilt_rad)}"
            )
            look = self._looks.look_at(shot, check=True)
            if look is not None and look.found:
                known.take(name, look, check=True)
        checks = known.of(name, check=True)
        pointings = []
        predicted_px = math.hypot(known.predicted_px(), known.floor_px)
        for told in point_at_corners(
            self._eyes,
            known.now,
            (name, known.board),
            known.workspace.cameras,
            checks,
            predicted_px,
            known.sought.sigma_px,
        ):
            x, y = told.residual_px
            self._teller.say(
                f"pointed at corner {told.corner}, {told.turned_deg:.0f} degrees off: residual {x:+.2f}, "
                f"{y:+.2f} px (promised {told.promised_px:.2f})"
            )
            pointings.append(told)
        return Checked(known.promised_px(checks, name), tuple(pointings))

    def _take_up(self) -> None:
        """Go on where the folder's last run ended."""
        known = self.known
        if not known.looks:
            return
        self._teller.say(f"going on with {self._kept.path}: {known.pictures()} pictures a camera are there")
        self._teller.step("fit")
        try:
            known.fit()
        except CalibError as reason:
            self._teller.say(f"not yet enough for a fit: {reason}")
            known.believe_boards()
        name = known.placements()[-1]
        self._teller.stands(name, self._kept.asked(name), self._eyes.head)
        if self._kept.is_over(name):
            return
        if self._looks.stands_still(name):
            self._teller.say(f"the board stands as it stood in placement {name}")
            self._looks.work_at(name, self._share())
        else:
            self._teller.say(f"the board does not stand any more as in placement {name}: that one is closed")
            self._kept.note(event="closed", name=name)

    def _enough(self) -> bool:
        over = [name for name in self.known.placements() if self._kept.is_over(name)]
        if len(over) >= self.wanted.placements[1] or self._room() <= 0:
            return True
        if not over:
            return False
        try:
            self.known.fit()
        except SomethingChanged:
            raise  # no other placement mends it
        except CalibError as reason:
            self._teller.say(f"no fit yet: {reason}")
        if len(over) < self.wanted.placements[0] or self._body_advice() is not None:
            return False
        return self.known.predicted_px() <= self.wanted.at_least_px(self.known.floor_px)

    def _body_advice(self) -> Advice | None:
        """Where the board would tie body cameras to the head that are not tied yet."""
        known, untied = self.known, self.known.untied()
        return advise_for_body(known.now, known.sought, known.shots, untied) if untied else None

    def _room(self) -> int:
        """Looks that may still be taken for the fit."""
        return self.wanted.pictures - self.wanted.checks - self.known.pictures()

    def _share(self) -> int:
        """How many looks one placement may have, so that there are some left for the others."""
        left = max(self.wanted.placements[0] + 1 - len(self.known.placements()), 1)
        return max(FEWEST_LOOKS, self._room() // left)

    def _next_placement(self) -> tuple[str, Placement]:
        known, name = self.known, f"p{len(self.known.placements()) + 1}"
        if not known.shots:
            return name, first_placement(known.now, known.sought)
        advice = self._body_advice() or advise(known.now, known.sought, known.shots, known.aim)
        if advice is None:
            raise MastctlError("no place for the board can be seen within the head's limits")
        return name, advice.placement
