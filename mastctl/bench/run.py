"""A bench calibration from the first look to the last: it drives the head and requests placements.

Everything that is seen is in the survey's folder before it is used, so a run that ends at any moment goes on
from there. At its end are images that are not fitted, and pointings at corners, beside what was promised.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from calib.calibrate.starts.bench import SomethingChanged
from calib.errors import CalibError
from calib.plan.placements import Advice, Placement, advise, advise_for_body, first_placement
from calib.survey.records import Sigma
from calib.targets.boards import AnyBoard
from mastctl.bench.check import Checked, point_at_corners, unvisited
from mastctl.bench.daemon_mast import DaemonMast
from mastctl.bench.folder import RunFolder
from mastctl.bench.frame import FitSurvey, FittedBench, RoverFrame, fit_in_rover, frame_of
from mastctl.bench.known import BenchKnowledge
from mastctl.bench.looks import FEWEST_LOOKS, BenchGoal, Looks, deg
from mastctl.bench.mast import BenchMast
from mastctl.bench.reporter import Reporter
from mastctl.bench.simulated import SimulatedBoard
from mastctl.client import Client
from mastctl.errors import MastctlError


class BenchRun:
    """One run; `run` returns when nothing more is wanted.

    ``kept`` is the survey's folder and the run's journal, ``fit`` makes a rig of the survey, ``simulated`` is
    the board of a simulated rover. ``known`` is all that was seen, and what follows from it.
    """

    def __init__(
        self,
        mast: BenchMast,
        kept: RunFolder,
        board: AnyBoard,
        reporter: Reporter,
        fit: FitSurvey,
        wanted: BenchGoal,
        simulated: SimulatedBoard | None = None,
    ) -> None:
        self.wanted, self._mast, self._reporter, self._kept = wanted, mast, reporter, kept
        self._simulated = simulated
        self.known = BenchKnowledge(mast.head, kept, board, fit, reporter.say)
        self._looks = Looks(mast, self.known, reporter, wanted)

    def run(self) -> FittedBench:
        """Take pictures until they suffice, and return the fit of all of them.

        Raises
        ------
        MastctlError
            If the head or the cameras fail, the board is not found, or it is stopped. What was seen is in the
            folder.
        CalibError
            If what was seen cannot be fitted; at the end of a placement already if something changed that no
            more pictures mend.
        """
        try:
            self._take_up()
            while not self._enough():
                name, placement = self._next_placement()
                self._reporter.place(name, placement)
                if self._simulated is not None:
                    self._simulated.stand(placement)
                self._kept.note(event="placement", name=name, asked=asdict(placement))
                self._looks.find(name, placement)
                self._looks.work_at(name, self._share())
            return self.known.fit()
        finally:
            self.known.end()

    def check(self) -> Checked:
        """Look where nothing was fitted, and point at corners, where the board stands now.

        Raises
        ------
        MastctlError
            As `run`.
        """
        known, name = self.known, self.known.placements()[-1]
        if self._looks.here != name and not self._looks.stands_still(name):
            self._reporter.say(f"not checked: the board does not stand any more as in placement {name}")
            return Checked({}, ())
        left = self.wanted.checks - sum(1 for _, check, _ in known.looks if check)
        for shot in unvisited(known, name, left):
            self._reporter.say(
                f"an image that is not fitted, at pan {deg(shot.pan_rad)}, tilt {deg(shot.tilt_rad)}"
            )
            look = self._looks.look_at(shot, check=True)
            if look is not None and look.found:
                known.take(name, look, check=True)
        checks = known.of(name, check=True)
        pointings = []
        for pointing in point_at_corners(self._mast, known, name, checks):
            self._reporter.say(pointing.sentence())
            pointings.append(pointing)
        return Checked(known.promised_px(checks, name), tuple(pointings))

    def _take_up(self) -> None:
        """Go on where the folder's last run ended."""
        known = self.known
        if not known.looks:
            return
        self._reporter.say(f"going on with {self._kept.path}: {known.pictures()} pictures a camera are there")
        self._reporter.step("fit")
        try:
            known.fit()
        except CalibError as reason:
            self._reporter.say(f"not yet enough for a fit: {reason}")
            known.believe_boards()
        name = known.placements()[-1]
        placement = self._kept.requested(name)
        if self._simulated is not None and placement is not None and not self._simulated.is_there:
            self._simulated.stand(placement)
        if self._kept.is_over(name):
            return
        if self._looks.stands_still(name):
            self._reporter.say(f"the board stands as it stood in placement {name}")
            self._looks.work_at(name, self._share())
        else:
            self._reporter.say(
                f"the board does not stand any more as in placement {name}: that one is closed"
            )
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
            self._reporter.say(f"no fit yet: {reason}")
        if len(over) < self.wanted.placements[0] or self._body_advice() is not None:
            return False
        return self.known.predicted_px() <= self.wanted.at_least_px(self.known.counts_px)

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


def open_run(
    client: Client,
    board: AnyBoard,
    folder: Path,
    reporter: Reporter,
    wanted: BenchGoal,
    cameras: Sequence[str] = (),
    frame: RoverFrame | None = None,
) -> BenchRun:
    """Return a run on a daemon's head, which ``client`` may steer, with a new or former survey ``folder``.

    Raises
    ------
    BadFile
        If the folder holds something else, or another run keeps its looks there.
    ClientError
        If the daemon refuses a question.
    """
    status = client.status()
    mast = DaemonMast(client, cameras or list(status["cameras"]), board)
    head = mast.head
    sigma = Sigma(0.0, 0.0, joint_rad=head.count_rad / 12**0.5, corner_px=0.1)
    kept = RunFolder(folder, board, sigma, head.rig)
    kept.begin(client.mast_file(), frame or RoverFrame())
    fit = fit_in_rover(frame_of(kept.notes), head.rig, kept.moved)
    simulated = SimulatedBoard(client, board, head.rig) if status["simulated"] else None
    return BenchRun(mast, kept, board, reporter, fit, wanted, simulated)
