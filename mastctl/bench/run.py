"""A bench calibration from the first look to the last: it drives the head and asks for placements.

Everything that is seen is in the survey's folder before anything is made of it, so a run that ends at any
moment goes on from there. At its end stand pictures that are not fitted, and pointings at corners, beside
what was promised.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from calib.calibrate.starts.bench import SomethingChanged
from calib.errors import CalibError, Unreachable
from calib.geometry.pointing import solve
from calib.geometry.rigid import FloatArray
from calib.geometry.solutions import Solution, choose
from calib.geometry.stereo import triangulate
from calib.plan.knowledge import BenchShot, Knowledge
from calib.plan.placements import Advice, Placement, advise, advise_for_body, first_placement
from calib.plan.poses import Sought, candidates, next_shot
from calib.survey.records import Sigma
from calib.targets.boards import AnyBoard
from mastctl.bench.daemon_eyes import DaemonEyes
from mastctl.bench.eyes import BenchEyes, BenchLook, NotThere, SeenBoard
from mastctl.bench.folder import RunFolder, survey_cameras
from mastctl.bench.frame import FitSurvey, FittedBench, RoverFrame, fit_in_rover, frame_of
from mastctl.bench.known import BenchKnowledge
from mastctl.bench.looks import FEWEST_LOOKS, BenchGoal, Looks, deg
from mastctl.bench.reporter import Reporter
from mastctl.bench.simulated import SimulatedBoard
from mastctl.client import Client
from mastctl.errors import MastctlError

POINTINGS = 4


@dataclass(frozen=True)
class CornerPointing:
    """A first pointing at a corner that was clicked off the middle.

    ``residual_px`` is where the corner came to lie in the new picture, less where it was to lie;
    ``promised_px`` one sigma of either number.
    """

    corner: int
    range_m: float
    turned_deg: float
    residual_px: tuple[float, float]
    promised_px: float


@dataclass(frozen=True, eq=False)
class Checked:
    """What the end of a bench showed.

    Attributes
    ----------
    promised_px
        Camera to what the fit promised of corners in pictures that were not fitted, rms per axis.
    pointings
        First pointings at corners.
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
        if not self.pointings:
            return None
        return float(np.sqrt(np.mean([one.promised_px**2 for one in self.pointings])))


def unvisited(
    known: Knowledge, sought: Sought, here: Sequence[BenchShot], placement: str, count: int
) -> Iterator[BenchShot]:
    """Yield attitudes that show the board, each as far as can be from all that were taken or yielded."""
    every = list(candidates(known, sought, here, placement))
    taken = [(shot.pan_rad, shot.tilt_rad) for shot in here]
    for _ in range(min(count, len(every))):
        far = [min((math.dist((s.pan_rad, s.tilt_rad), at) for at in taken), default=9.0) for s in every]
        shot = every.pop(int(np.argmax(far)))
        taken.append((shot.pan_rad, shot.tilt_rad))
        yield shot


def point_at_corners(
    eyes: BenchEyes,
    known: Knowledge,
    stands: tuple[str, AnyBoard],
    cameras: Sequence[str],
    clicked: Sequence[BenchLook],
    promised_px: float,
    corner_px: float,
) -> Iterator[CornerPointing]:
    """Point once at corners that former looks show off the middle, and yield what was measured.

    Parameters
    ----------
    eyes, known
        The head, and the fitted rig with the boards' places.
    stands
        The placement, and the board that stands there.
    cameras
        The camera that points, and its partner if there is one.
    clicked
        Looks that were not fitted.
    promised_px, corner_px
        Rms per axis that calibration and counts leave, and sigma of a found corner.
    """
    rng = np.random.default_rng(len(clicked))
    done = 0
    for look in [*clicked, *clicked]:
        if done >= POINTINGS:
            return
        seen = {one.camera: one for one in look.found}
        if any(camera not in seen for camera in cameras):
            continue
        common = _common([seen[camera] for camera in cameras])
        rng.shuffle(common)
        for corner in common[:2]:
            told = _point(eyes, known, stands, cameras, look, seen, int(corner), promised_px, corner_px)
            if told is not None:
                done += 1
                yield told
                break


def _common(seen: Sequence[SeenBoard]) -> FloatArray:
    ids = [set(one.corners.ids.tolist()) for one in seen if one.corners is not None]
    return np.array(sorted(set.intersection(*ids)))


def _point(
    eyes: BenchEyes,
    known: Knowledge,
    stands: tuple[str, AnyBoard],
    cameras: Sequence[str],
    look: BenchLook,
    seen: Mapping[str, SeenBoard],
    corner: int,
    promised_px: float,
    corner_px: float,
) -> CornerPointing | None:
    """Bring one corner to the middle of the first camera's picture; None where that cannot be tried."""
    rig, camera = known.rig, cameras[0]
    model, head = rig.cameras[camera].model, eyes.head
    pixels = [_pixel(seen[name], corner) for name in cameras]
    here = [_true(known, seen[name], look) for name in cameras]
    models = [rig.camera_in_rover(name, *at) for name, at in zip(cameras, here, strict=True)]

    def read_rad(angles: Solution) -> tuple[float, float]:
        return rig.joints.read_rad((angles.pan_rad, angles.tilt_rad))

    try:
        if len(cameras) > 1:
            point = triangulate(models[0], models[1], pixels[0], pixels[1]).position_m
        else:  # one eye is told the range: how far the corner is by the fit
            ray = models[0].ray(pixels[0])
            name, board = stands
            (there_m,) = known.boards[name].points(board.in_board_m(np.array([corner])))
            point = ray.origins_m + ray.directions * float(np.linalg.norm(there_m - ray.origins_m))
        found = solve(rig.mast, model, point, from_pan_rad=here[0][0], from_tilt_rad=here[0][1])
        angles = choose(
            found, head.pan_limits_rad, head.tilt_limits_rad, look.pan_rad, look.tilt_rad, read=read_rad
        )
    except (Unreachable, CalibError):
        return None
    sides = (0, 0)
    if not head.one_sided:
        sides = (1 if angles.pan_rad > here[0][0] else -1, 1 if angles.tilt_rad > here[0][1] else -1)
    try:
        landed = eyes.look(*rig.joints.read_rad((angles.pan_rad, angles.tilt_rad), sides), sides)
    except NotThere:
        return None
    seen_there = next((one for one in landed.found if one.camera == camera), None)
    if seen_there is None or seen_there.corners is None or corner not in seen_there.corners.ids:
        return None
    x, y = _pixel(seen_there, corner) - np.asarray(model.image_center_px)
    turned = math.hypot(angles.pan_rad - here[0][0], angles.tilt_rad - here[0][1])
    return CornerPointing(
        corner,
        float(np.linalg.norm(point - models[0].C)),
        math.degrees(turned),
        (float(x), float(y)),
        math.sqrt(promised_px**2 + 2.0 * corner_px**2),
    )


def _pixel(seen: SeenBoard, corner: int) -> FloatArray:
    assert seen.corners is not None
    return np.asarray(seen.corners.pixels_px[int(np.flatnonzero(seen.corners.ids == corner)[0])])


def _true(known: Knowledge, seen: SeenBoard, look: BenchLook) -> tuple[float, float]:
    return known.rig.joints.true_rad((seen.pan_rad, seen.tilt_rad), (look.pan_approach, look.tilt_approach))


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
    reporter
        Shows the operator how it goes, and has the board placed.
    fit
        Makes a rig of the survey.
    wanted
        What to reach.
    simulated
        The board of a simulated rover.

    Attributes
    ----------
    known
        All that was seen and follows from it.
    """

    def __init__(
        self,
        eyes: BenchEyes,
        kept: RunFolder,
        board_name: str,
        board: AnyBoard,
        reporter: Reporter,
        fit: FitSurvey,
        wanted: BenchGoal,
        simulated: SimulatedBoard | None = None,
    ) -> None:
        self.wanted, self._eyes, self._reporter, self._kept = wanted, eyes, reporter, kept
        self._simulated = simulated
        self.known = BenchKnowledge(eyes.head, kept, board_name, board, fit, reporter.say)
        self._looks = Looks(eyes, self.known, reporter, wanted)

    def run(self) -> FittedBench:
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
                self._reporter.place(name, placement)
                if self._simulated is not None:
                    self._simulated.stand(placement)
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
            self._reporter.say(f"not checked: the board does not stand any more as in placement {name}")
            return Checked({}, ())
        left = self.wanted.checks - sum(1 for _, check, _ in known.looks if check)
        here = [shot for shot in known.shots if shot.placement == name]
        for shot in unvisited(known.now, known.sought, here, name, left):
            self._reporter.say(
                f"a picture that is not fitted, at pan {deg(shot.pan_rad)}, tilt {deg(shot.tilt_rad)}"
            )
            look = self._looks.look_at(shot, check=True)
            if look is not None and look.found:
                known.take(name, look, check=True)
        checks = known.of(name, check=True)
        pointings = []
        predicted_px = math.hypot(known.predicted_px(), known.counts_px)
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
            self._reporter.say(
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
        self._reporter.say(f"going on with {self._kept.path}: {known.pictures()} pictures a camera are there")
        self._reporter.step("fit")
        try:
            known.fit()
        except CalibError as reason:
            self._reporter.say(f"not yet enough for a fit: {reason}")
            known.believe_boards()
        name = known.placements()[-1]
        placement = self._kept.asked(name)
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
    eyes = DaemonEyes(client, cameras or list(status["cameras"]), board)
    head = eyes.head
    sizes = {name: camera.model.size_px for name, camera in head.rig.cameras.items()}
    sigma = Sigma(0.0, 0.0, joint_rad=head.count_rad / 12**0.5, corner_px=0.1)
    kept = RunFolder(folder, {"board": board}, sigma, survey_cameras(head.rig, sizes), head.rig.stereo)
    kept.begin(client.mast_file(), frame or RoverFrame())
    fit = fit_in_rover(frame_of(kept.notes), head.rig, kept.moved)
    simulated = SimulatedBoard(client, board, head.rig) if status["simulated"] else None
    run = BenchRun(eyes, kept, "board", board, reporter, fit, wanted, simulated)
    pointing = run.known.workspace.cameras
    took_s = eyes.seconds_each() if len(head.rig.cameras) > len(pointing) else {}
    if set(pointing) <= took_s.keys():
        reporter.say(wanted.will_take(took_s, pointing, run.choice_s()))
    return run
