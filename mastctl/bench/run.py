"""A bench calibration from the first look to the last: it drives the head and asks for placements.

Everything that is seen is in the survey's folder before anything is made of it, so a run that ends at any
moment goes on from there. What a look shows is fitted beside the next moves; the next pose is chosen by what
the estimator's information matrix says of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace

import numpy as np

from calib.bench.board_pose import rover_from_board
from calib.bench.knowledge import Knowledge, Shot, View
from calib.bench.placements import Advice, Placement, advise, first_placement
from calib.bench.poses import Choice, Sought, expected_px, next_shot, with_board
from calib.bench.workspace import Pointing, Workspace, pointing
from calib.boards import AnyBoard
from calib.errors import CalibError
from calib.fit.least_squares import covariance_of
from calib.rigid import Rigid, rigid_rates
from calib.survey import Survey
from mastctl.bench.eyes import Eyes, Head, Look, NotThere
from mastctl.bench.final import Checked, point_at_corners, unvisited
from mastctl.bench.fitting import FitSurvey, Fitted
from mastctl.bench.folder import Kept, looks_of
from mastctl.bench.search import Search
from mastctl.bench.teller import Progress, Teller
from mastctl.errors import MastctlError

FEWEST_LOOKS = 8
"""Of a placement: fewer leave the board's own place, and so what it tells, to chance."""

LITTLE_GAIN, LAST_GAIN = 0.12, 0.01
"""A look that promises less than this part of the predicted error is not worth its time at a placement, or at
the last one that there may be."""

MOVED_PX = 1.0
"""Corners further off than this at one and the same attitude, on the median, say that something moved."""

UNSEEN_IN_A_ROW = 4
"""Looks in a row that did not show the board where it was expected: it was taken away, or has moved."""


class BoardLost(MastctlError):
    """The board is not where it was."""

    code = "board_lost"


@dataclass(frozen=True)
class Wanted:
    """What a run is to reach, and when it stops trying.

    Attributes
    ----------
    pointing_px
        Rms per axis of a first pointing that the calibration may leave, on paper.
    pictures
        Of a camera, at most; the check's are among them.
    placements
        Fewest and most.
    checks
        Looks that are not fitted.
    """

    pointing_px: float = 0.2
    pictures: int = 60
    placements: tuple[int, int] = (2, 4)
    checks: int = 5


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
    asks
        Who places the board, and is told how it goes.
    fit
        Makes a rig of the survey.
    wanted
        What to reach.
    """

    def __init__(
        self,
        eyes: Eyes,
        kept: Kept,
        board_name: str,
        board: AnyBoard,
        teller: Teller,
        fit: FitSurvey,
        wanted: Wanted = Wanted(),
    ) -> None:
        self._eyes, self._kept, self._teller = eyes, kept, teller
        self._board_name, self._board, self._fit = board_name, board, fit
        self.wanted = wanted
        head = eyes.head
        self._workspace = Workspace(
            first_cameras(head.rig),
            _within(head.pan_limits_rad, (-1.2, 1.2)),
            _within(head.tilt_limits_rad, (-0.9, 0.3)),
            one_sided=head.one_sided,
        )
        every = board.in_board_m(board.ids)
        least = len(every) if board.kind in ("dots", "checkerboard") else max(8, len(every) // 8)
        self._sought = Sought(
            every, kept.sigma_px, least, head.pan_limits_rad, head.tilt_limits_rad, head.one_sided
        )
        # A count is rounded both when the head is sent and when it is read.
        self._known = Knowledge(head.rig, {}, head.count_rad / math.sqrt(12.0))
        self._aim = pointing(self._known, self._workspace)
        self._shots: list[Shot] = []
        self._looks: list[tuple[str, bool, Look]] = list(looks_of(kept.survey()))
        self._scale = 1.0
        self._here = ""  # the placement that was worked at, and whose board so stands there
        self._fitted_looks = 0
        self._pool = ThreadPoolExecutor(1, "bench-fit")
        self._pending: tuple[int, Future[Fitted]] | None = None
        self.fitted: Fitted | None = None

    @property
    def known(self) -> Knowledge:
        """The present estimate."""
        return self._known

    @property
    def shots(self) -> Sequence[Shot]:
        """What was taken to be fitted."""
        return tuple(self._shots)

    @property
    def aim(self) -> Pointing:
        """What the rig is for."""
        return self._aim

    @property
    def floor_px(self) -> float:
        """What the head's counts alone leave, rms per axis."""
        return self._aim.by_counts_px(self._known.joint_sigma_rad)

    @property
    def target_px(self) -> float:
        """What the calibration may leave: as asked, or what the counts leave anyway."""
        return max(self.wanted.pointing_px, self.floor_px)

    def predicted_px(self) -> float:
        """What the pictures up to now leave, on paper."""
        return expected_px(self._known, self._shots, self._aim) if self._shots else math.inf

    def run(self) -> Fitted:
        """Take pictures until they suffice, and return the fit of all of them.

        Raises
        ------
        MastctlError
            If the head or the cameras fail, the board is not found, or somebody stops it. What was seen is in
            the folder.
        CalibError
            If what was seen cannot be fitted.
        """
        try:
            self._take_up()
            while not self._enough():
                name, placement = self._next_placement()
                self._teller.place(name, placement, self._eyes.head)
                self._kept.note(event="placement", name=name, asked=asdict(placement))
                self._work_at(name, placement)
            self._collect(wait=True)
            if self._fitted_looks < len(self._looks):
                self._use(self._fit(self._kept.survey()))
            assert self.fitted is not None
            return self.fitted
        finally:
            self._pool.shutdown(wait=False, cancel_futures=True)

    def check(self) -> Checked:
        """Look where nothing was fitted, and point at corners, where the board stands now.

        Raises
        ------
        MastctlError
            As `run`.
        """
        assert self.fitted is not None
        name = self._placements()[-1]
        if self._here != name and not self._stands_still(name):
            self._teller.say(f"not checked: the board does not stand any more as in placement {name}")
            return Checked({}, ())
        old = [look for placement, check, look in self._looks if check]
        here = [shot for shot in self._shots if shot.placement == name]
        for shot in unvisited(self._known, self._sought, here, name, self.wanted.checks - len(old)):
            self._teller.say(
                f"a picture that is not fitted, at pan {_deg(shot.pan_rad)}, tilt {_deg(shot.tilt_rad)}"
            )
            look = self._look_at(shot)
            if look is not None and look.found:
                self._took(name, look, check=True)
        new = [look for placement, check, look in self._looks if check and placement == name]
        predicted_px = math.hypot(self.predicted_px(), self.floor_px)
        pointings = []
        for told in point_at_corners(
            self._eyes,
            self._known,
            self._board,
            self._workspace.cameras,
            new,
            predicted_px,
            self._sought.sigma_px,
        ):
            x, y = told.residual_px
            self._teller.say(
                f"pointed at corner {told.corner}, {told.turned_deg:.0f} degrees off: residual {x:+.2f}, "
                f"{y:+.2f} px (promised {told.promised_px:.2f})"
            )
            pointings.append(told)
        return Checked(self._promised(new, name), tuple(pointings))

    def _promised(self, looks: Sequence[Look], name: str) -> dict[str, float]:
        """What corners of looks that were not fitted should be off by, rms per axis, by camera."""
        told: dict[str, list[float]] = {}
        joint = self._known.joint_sigma_rad
        covariance = covariance_of(with_board(self._known, self._shots, name))
        for look in looks:
            shot = self._shot(name, look)
            for view in shot.views:
                board = self._known.boards[name]
                points = board.points(view.in_board_m)
                rates = self._known.rates(view.camera, shot, points)
                to_board = rigid_rates(rates.to_points, points, board.translation_m)
                both = np.concatenate([rates.to_rig, to_board], axis=2)
                by_rig = np.einsum("nip,pq,niq->ni", both, covariance, both)
                by_joints = joint**2 * (rates.to_joints**2).sum(axis=2)
                told.setdefault(view.camera, []).append(
                    float(np.mean(by_rig + by_joints)) + self._sought.sigma_px**2
                )
        return {camera: math.sqrt(np.mean(values)) for camera, values in told.items()}

    def fit_all(self) -> Fitted:
        """Return the fit of everything that was seen, the check's pictures left out of it and told beside."""
        self._use(self._fit(self._kept.survey()))
        assert self.fitted is not None
        return self.fitted

    def survey(self) -> Survey:
        """Return what was seen."""
        return self._kept.survey()

    def seconds(self) -> float:
        """Return how long all looks took, seconds of the rover's clock."""
        return self._kept.seconds()

    def placements(self) -> list[str]:
        """Return the names of the placements."""
        return self._placements()

    def pictures(self) -> int:
        """Return how many pictures the camera with most has."""
        return self._taken()

    @property
    def name(self) -> str:
        """The rig's name."""
        return self._eyes.head.rig.name

    @property
    def head(self) -> Head:
        """The head as it was known before."""
        return self._eyes.head

    @property
    def workspace(self) -> Workspace:
        """Where it points."""
        return self._workspace

    # -- what was done before -------------------------------------------------------------------------

    def _take_up(self) -> None:
        """Make of the folder what a run that was not ended would know."""
        if not self._looks:
            return
        self._teller.say(f"going on with {self._kept.path}: {self._taken()} pictures a camera are there")
        try:
            self._use(self._fit(self._kept.survey()))
        except CalibError as reason:
            self._teller.say(f"not yet enough for a fit: {reason}")
            self._believe_boards()
        self._fitted_looks = len(self._looks)
        name = self._placements()[-1]
        self._teller.stands(name, self._asked(name), self._eyes.head)
        if self._is_finished(name):
            return
        if self._stands_still(name):
            self._teller.say(f"the board stands as it stood in placement {name}")
            self._work_at(name, None)
        else:
            self._teller.say(f"the board does not stand any more as in placement {name}: that one is closed")
            self._kept.note(event="closed", name=name)

    def _asked(self, name: str) -> Placement | None:
        """What was asked for at a placement."""
        for note in self._kept.notes:
            if note.get("event") == "placement" and note.get("name") == name:
                asked = dict(note["asked"])
                return Placement(**{**asked, "turned_deg": tuple(asked["turned_deg"])})
        return None

    def _stands_still(self, name: str) -> bool:
        """Whether the last attitude of a placement shows now what it showed then."""
        last = [look for placement, _, look in self._looks if placement == name][-1]
        now = self._eyes.look(last.pan_rad, last.tilt_rad, (last.pan_approach, last.tilt_approach))
        apart = corners_apart_px(last, now)
        return apart is not None and apart <= MOVED_PX

    def _is_finished(self, name: str) -> bool:
        return any(
            note.get("name") == name and note.get("event") in ("closed", "done") for note in self._kept.notes
        )

    # -- placements ------------------------------------------------------------------------------------

    def _placements(self) -> list[str]:
        return list(dict.fromkeys(placement for placement, _, _ in self._looks))

    def _fitting(self) -> int:
        return sum(1 for _, check, _ in self._looks if not check)

    def _taken(self) -> int:
        """Pictures that the camera with most of them has."""
        counts: dict[str, int] = {}
        for _, _, look in self._looks:
            for one in look.found:
                counts[one.camera] = counts.get(one.camera, 0) + 1
        return max(counts.values(), default=0)

    def _enough(self) -> bool:
        done = [name for name in self._placements() if self._is_finished(name)]
        if len(done) >= self.wanted.placements[1] or self._room() <= 0:
            return True
        self._collect(wait=True)
        self._refit_if_new()
        return len(done) >= self.wanted.placements[0] and self.predicted_px() <= self.target_px

    def _room(self) -> int:
        """Looks that may still be taken for the fit."""
        return self.wanted.pictures - self.wanted.checks - self._taken()

    def _next_placement(self) -> tuple[str, Placement]:
        number = len(self._placements()) + 1
        if not self._shots:
            return f"p{number}", first_placement(self._known, self._sought)
        advice = self._advice()
        if advice is None:
            raise MastctlError("no place for the board can be seen within the head's limits")
        return f"p{number}", advice.placement

    def _advice(self) -> Advice | None:
        return advise(self._known, self._sought, self._shots, self._aim)

    def _work_at(self, name: str, placement: Placement | None) -> None:
        """Find the board, if it has not been found here, and take what tells most."""
        if placement is not None:
            search = Search(self._eyes, self._known, self._sought, self._teller)
            self._took(name, search.find(placement))
        self._here = name
        share = self._share()
        in_vain: list[tuple[float, float]] = []
        missed = 0
        while True:
            here = sum(1 for p, _, _ in self._looks if p == name)
            self._collect()
            choice = next_shot(self._known, self._sought, self._shots, name, self._aim, in_vain)
            if choice is None or here >= share or self._suffices(here, choice):
                break
            self._tell(name, choice)
            shot = choice.shot
            look = self._look_at(shot)
            if look is None:
                in_vain.append((shot.pan_rad, shot.tilt_rad))
                continue
            if not look.found:
                in_vain.append((shot.pan_rad, shot.tilt_rad))
                missed += 1
                self._teller.say(_not_seen(look))
                if missed >= UNSEEN_IN_A_ROW:
                    raise BoardLost(
                        f"the board of placement {name} was not seen in {missed} looks in a row where "
                        "it stood; put it back or place it anew, and start the same command again"
                    )
                continue
            missed = 0
            self._took(name, look)
        self._close(name)

    def _look_at(self, shot: Shot) -> Look | None:
        """Take a shot; None where the head must not go."""
        try:
            return self._eyes.look(shot.pan_rad, shot.tilt_rad, (shot.pan_approach, shot.tilt_approach))
        except NotThere as reason:
            self._teller.say(f"not looked there: {reason}")
            return None

    def _share(self) -> int:
        """How many looks one placement may have, so that there are some left for the others."""
        left = max(self.wanted.placements[0] + 1 - len(self._placements()), 1)
        return max(FEWEST_LOOKS, self._room() // left)

    def _suffices(self, here: int, choice: Choice) -> bool:
        if here < FEWEST_LOOKS:
            return False
        now = self.predicted_px()
        if now <= 0.7 * self.target_px and self._fitted_looks >= here:
            return True
        little = LAST_GAIN if len(self._placements()) >= self.wanted.placements[1] else LITTLE_GAIN
        return choice.expected_px > (1.0 - little) * now

    def _close(self, name: str) -> None:
        """Look once more where the placement began: did the board, or the head, stay as it was?"""
        first = next(look for placement, _, look in self._looks if placement == name)
        again = self._eyes.look(first.pan_rad, first.tilt_rad, (first.pan_approach, first.tilt_approach))
        apart = corners_apart_px(first, again)
        if apart is not None and apart > self._allowed_px():
            self._teller.say(
                f"placement {name}: its first picture taken again shows the board {apart:.1f} px aside: the "
                "board or the head moved meanwhile; the fit will tell which pictures to leave out"
            )
            self._kept.note(event="moved", name=name, apart_px=round(apart, 2))
        self._kept.note(event="done", name=name)

    def _allowed_px(self) -> float:
        """How far one attitude may show a board aside: what two readings may differ by, and more."""
        camera = self._eyes.head.rig.cameras[self._workspace.cameras[0]].model
        return MOVED_PX + 3.0 * self._eyes.head.count_rad * float(np.linalg.norm(camera.H))

    # -- looks and fits ----------------------------------------------------------------------------------

    def _took(self, name: str, look: Look, check: bool = False) -> None:
        """Keep a look, and add it to what is known."""
        self._kept.add(name, self._board_name, look, check)
        self._looks.append((name, check, look))
        if name not in self._known.boards:
            self._known = replace(self._known, boards={**self._known.boards, name: self._board_from(look)})
        if not check:
            self._shots.append(self._shot(name, look))
        self._collect()
        if self._pending is None and _worth_a_fit(self._fitting(), self._fitted_looks):
            self._begin_fit()

    def _shot(self, name: str, look: Look) -> Shot:
        views = tuple(
            View(one.camera, self._board.in_board_m(one.corners.ids), self._scale * one.corners.sigma_px)
            for one in look.found
            if one.corners is not None and one.camera in self._known.rig.cameras
        )
        return Shot(name, look.pan_rad, look.tilt_rad, views, look.pan_approach, look.tilt_approach)

    def _board_from(self, look: Look) -> Rigid:
        """Where the board is, by the picture that shows most of it."""
        one = max(look.found, key=lambda seen: 0 if seen.corners is None else len(seen.corners))
        assert one.corners is not None
        true_rad = self._known.rig.joints.true_rad(
            (one.pan_rad, one.tilt_rad), (look.pan_approach, look.tilt_approach)
        )
        in_board_m = self._board.in_board_m(one.corners.ids)
        return rover_from_board(self._known.rig, one.camera, *true_rad, in_board_m, one.corners.pixels_px)

    def _begin_fit(self) -> None:
        survey = self._kept.survey()
        self._pending = len(self._looks), self._pool.submit(self._fit, survey)

    def _collect(self, wait: bool = False) -> None:
        """Take over a fit that is ready; with ``wait``, the one under way."""
        if self._pending is None or not (wait or self._pending[1].done()):
            return
        looks, future = self._pending
        self._pending = None
        try:
            self._use(future.result())
            self._fitted_looks = looks
        except CalibError as reason:
            self._teller.say(f"no fit yet: {reason}")

    def _refit_if_new(self) -> None:
        if self._looks and self._fitted_looks < len(self._looks):
            try:
                self._use(self._fit(self._kept.survey()))
                self._fitted_looks = len(self._looks)
            except CalibError as reason:
                self._teller.say(f"no fit yet: {reason}")

    def _use(self, fitted: Fitted) -> None:
        """Let the fit be the present estimate; boards that it does not know stay where they were seen."""
        self.fitted = fitted
        self._known = replace(self._known, rig=fitted.rig, boards=dict(fitted.boards))
        self._believe_boards()
        self._scale = fitted.sigma_scale
        self._sought = replace(self._sought, sigma_px=fitted.corner_rms_px)
        self._aim = pointing(self._known, self._workspace)
        self._shots = [self._shot(name, look) for name, check, look in self._looks if not check]

    def _believe_boards(self) -> None:
        """See boards that no fit has placed with the present rig."""
        for name, _, look in self._looks:
            if name not in self._known.boards:
                board = self._board_from(look)
                self._known = replace(self._known, boards={**self._known.boards, name: board})
        self._shots = [self._shot(name, look) for name, check, look in self._looks if not check]

    def _tell(self, name: str, choice: Choice) -> None:
        self._teller.progress(
            Progress(
                name,
                self._taken(),
                self.wanted.pictures,
                self.predicted_px(),
                self.target_px,
                self.floor_px,
                (choice.shot.pan_rad, choice.shot.tilt_rad),
                choice.expected_px,
                self.coverage(),
            )
        )

    def coverage(self) -> dict[str, float]:
        """Return the part of each camera's picture in which corners were seen, 0 to 1, in 8 x 6 cells."""
        cells: dict[str, set[tuple[int, int]]] = {}
        for _, check, look in self._looks:
            for one in () if check else look.found:
                if one.corners is None or one.camera not in self._known.rig.cameras:
                    continue
                width, height = self._known.rig.cameras[one.camera].model.size_px
                at = np.floor((one.corners.pixels_px + 0.5) * [8 / width, 6 / height]).astype(int)
                cells.setdefault(one.camera, set()).update(map(tuple, at.tolist()))
        return {camera: min(len(found) / 48.0, 1.0) for camera, found in cells.items()}


def first_cameras(rig: object) -> tuple[str, ...]:
    """Return the cameras that point: the Navcam pair, else a pair on the head, else one camera."""
    from calib.mast.rig import Rig

    assert isinstance(rig, Rig)
    pairs = {n: p for n, p in rig.stereo.items() if all(rig.cameras[c].on == "head" for c in p)}
    if pairs:
        return pairs.get("navcam") or next(iter(pairs.values()))
    single = [name for name, camera in rig.cameras.items() if camera.on == "head"]
    if not single:
        raise MastctlError("the mast file has no camera on the head, and so no head to calibrate")
    return (single[0],)


def corners_apart_px(then: Look, now: Look) -> float | None:
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


def _worth_a_fit(looks: int, fitted: int) -> bool:
    """Whether there is a fifth more to fit than the last time."""
    return looks >= 4 and looks >= fitted + max(2, fitted // 5)


def _within(limits_rad: tuple[float, float], usual_rad: tuple[float, float]) -> tuple[float, float]:
    """What of the usual range the limits leave; the limits where that is nothing."""
    low, high = max(limits_rad[0], usual_rad[0]), min(limits_rad[1], usual_rad[1])
    return (low, high) if low < high else limits_rad


def _deg(angle_rad: float) -> str:
    return f"{math.degrees(angle_rad):+.0f} degrees"


def _not_seen(look: Look) -> str:
    whys = dict.fromkeys(one.why for one in look.seen if one.why)
    return "the board is not seen here: " + "; ".join(whys or ("no corners found",))
