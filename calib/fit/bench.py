"""Fit a head on a bench: cameras, their place in the head, axes, joints' errors and boards, from pictures
alone.

The estimator is that of surveys (``calib.fit.adjustment``), with boards of unknown pose and no station. Start
(``calib.fit.bench_start``), pulls bounded, what changed half-way told apart (``calib.fit.bench_changes``),
blunders left out by the tests of ``calib.fit.outliers``, terms chosen (``calib.fit.model_terms``), least
squares.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from calib.camera.cahvor import Kind
from calib.fit.adjustment import HUBER, MAST, Adjustment, Estimate
from calib.fit.bench_calibration import BenchCalibration, TermGain
from calib.fit.bench_changes import find_change, reading_rates
from calib.fit.bench_start import BenchNotFitted, BenchStart, bench_start
from calib.fit.bench_terms import BenchTerms, bench_terms
from calib.fit.calibration import ImageResiduals
from calib.fit.joint import Weighed, goodness, weigh, without_blunders
from calib.fit.least_squares import Minimum, covariance_of, minimise
from calib.fit.model_terms import AXIS_TERMS, Tested, candidate_terms, choose_terms, joint_numbers
from calib.fit.outliers import FALSE_ALARMS, name_outliers
from calib.fit.residuals import image_residuals, rms_by_camera
from calib.fit.start_values import SurveyNotFitted
from calib.fit.stray_dots import stray_points
from calib.fit.term_motions import moves_px, term_motions
from calib.fit.terms import ImageTerm, with_kept
from calib.fit.uncertainty import open_directions, sigma_by_key
from calib.fit.usual_lens import lens_notes
from calib.fit.view_poses import ViewPoses, ViewsTooFew, view_poses
from calib.mast.covariance import RigCovariance
from calib.mast.gimbal import MAST_NAMES
from calib.mast.joints import JOINTS_NAMES
from calib.mast.rig import Rig, RigCamera
from calib.rigid import FloatArray, Rigid
from calib.survey import Survey

WRONG_MINIMUM = 3.0
"""A fit is refused if a camera's typical corner is this many times farther off than its sigma says."""

TURNABOUTS = 0.34
"""A board stood at two places in turn if no cut divides its pictures but for this part of the fewer ones."""

SCAN_HUBER = 100.0
"""Length in sigmas from which pulls are bounded while changes are looked for: these are no blunders."""

LONE = 6.0
"""While changes are looked for, a corner so many times farther off than its image's median counts as
wrong."""

SLIP_RAD, SLIP_ASIDE = 0.003, 0.1
"""A board that moved by more than this about the pan axis, and by less than this part of it otherwise
(radians and metres), did not move: pan slipped."""

CHECK_SIGMAS = 4.0
"""Check images that are off by so many sigmas more than expected were not predicted."""

CHANGES = 4
"""Boards that moved are looked for so many times."""

AXES = tuple(MAST_NAMES.index(names[0].removeprefix("mast.")) for names in AXIS_TERMS.values())


@dataclass(frozen=True)
class BenchOptions:
    """What is chosen and not measured.

    Attributes
    ----------
    kind
        Camera model of all cameras; None: as the survey says for each.
    terms
        The terms that enter; None: those that are significant.
    rover_from_mast
        Where the rover frame is: the mast's frame at zero angles in it, as a level and a tape give it.
        Default: it is the mast's.
    rover_from_board
        Or the board and placement whose pose is known, and that pose.
    """

    kind: Kind | None = None
    terms: Sequence[str] | None = None
    rover_from_mast: Rigid | None = None
    rover_from_board: tuple[tuple[str, str], Rigid] | None = None


def fit_bench(survey: Survey, options: BenchOptions | None = None) -> BenchCalibration:
    """Fit a rig to a bench's pictures, every measurement weighted by its sigma.

    Parameters
    ----------
    survey
        With ``boards`` and ``corners``; check images take no part.
    options
        What is chosen.

    Raises
    ------
    BenchNotFitted
        If the pictures do not determine a rig, something changed while they were taken, or the fit ends far
        from the noise: it is never reported as done.
    """
    began = time.perf_counter()
    options = options or BenchOptions()
    try:
        return _Fit(survey, options).calibration(began)
    except SurveyNotFitted as error:
        raise BenchNotFitted(str(error)) from None


class _Fit:
    """The way from a survey to a calibration."""

    def __init__(self, survey: Survey, options: BenchOptions) -> None:
        self.survey, self.options = survey, options
        self.terms: BenchTerms = bench_terms(survey)
        self.notes = list(self.terms.notes)
        self.joint_rad = survey.sigma.joint_rad
        if not any(t.attitude is not None for t in self.terms.images):
            raise BenchNotFitted(
                "no picture of a head camera shows a board: the head cannot be calibrated; at least 20 "
                "pictures are expected, with pan and tilt both moved between them"
            )
        self.cameras = {t.camera: survey.cameras[t.camera] for t in self.terms.images}
        self.boards = tuple(dict.fromkeys(t.board[0] for t in self.terms.images))
        self.split: list[tuple[tuple[str, str], tuple[str, str], str]] = []
        self.views = self._views()
        self.begin()

    def begin(self) -> None:
        """Find where to start, and leave out placements that no head camera shows.

        A board that stood elsewhere in all pictures from some one on counts as two placements.
        """
        start = self._start()
        for _ in range(CHANGES):
            if not start.elsewhere:
                break
            board, elsewhere = next(iter(start.elsewhere.items()))
            self._moved_far(board, elsewhere)
            start = self._start()
        self.notes += start.notes
        images = [t for t in self.terms.images if t.board in start.estimate.rover_from_board]
        checks = [t for t in self.terms.checks if t.board in start.estimate.rover_from_board]
        self.terms = replace(self.terms, images=tuple(images), checks=tuple(checks))
        self.start, self.doubtful = self._in_rover(start.estimate), start.doubtful
        self.boards = tuple(dict.fromkeys(t.board[0] for t in images))

    def _start(self) -> BenchStart:
        return bench_start(self.terms.images, self.views, self.terms.attitudes if self.joint_rad > 0 else 0)

    def _moved_far(self, board: tuple[str, str], elsewhere: frozenset[str]) -> None:
        """Split the placement of a board that moved; refuse one that stood at two places in turn."""
        shown = [t for t in self.terms.images if t.board == board]
        there = np.array([t.name in elsewhere for t in shown])
        changes = np.flatnonzero(there[1:] != there[:-1])
        # A picture that says nothing clear may lie on either side: the change is where it divides best.
        wrong = [
            int(min((~there[:k]).sum() + there[k:].sum(), there[:k].sum() + (~there[k:]).sum()))
            for k in range(len(shown) + 1)
        ]
        cut = int(np.argmin(wrong))
        if wrong[cut] > TURNABOUTS * there.sum():
            first = [shown[i + 1].name for i in changes[:3]]
            raise BenchNotFitted(
                f"board {board[0]} of placement {board[1]} stands at two places, now at one and now at the "
                f"other (pictures {', '.join(first)} and others): two boards have the same ids, or it was "
                "moved and put back; leave one board only, or print the other with other ids (first_id)"
            )
        before, after = shown[cut - 1].name, shown[cut].name
        self.notes.append(
            f"board {board[0]} moved during placement {board[1]}, between pictures {before} and {after}; "
            "from there on it counts as another placement"
        )
        self._split(board, after)

    def look_for_changes(self, chosen: Sequence[str]) -> tuple[Adjustment, Estimate]:
        """Return the problem with some terms, lone wrong corners left out, and its fit.

        A board that moved counts as two placements.

        Raises
        ------
        BenchNotFitted
            If a joint slipped, or a camera changed: nothing says which of its two states is the one to come.
        """
        strays = {n: s for view in self.views.values() for n, s in view.strays.items()}
        for left in range(CHANGES, -1, -1):
            problem = self.seen(chosen, self.start)
            problem = problem.with_terms(
                [replace(t, keep=t.keep & ~strays[t.name]) for t in problem.images], ()
            )
            fit = minimise(problem, self.start, weak=problem.weak, gain=1e-4)
            problem = _without_lone_strays(problem, fit.state).with_huber(SCAN_HUBER)
            fit = minimise(problem, fit.state, weak=problem.weak, gain=1e-6)
            if not np.isfinite(fit.normal.cost) or not left:
                break
            covariance = covariance_of(fit.normal.matrix, problem.weak)
            freedom = sum(2 * int(t.keep.sum()) for t in problem.images) - len(problem.names)
            change = find_change(problem, fit.state, covariance, fit.normal.cost, freedom)
            self._refuse_slip(fit.state)
            if change is None:
                break
            if change.board is None:
                raise BenchNotFitted(change.sentence)
            self.notes.append(f"{change.sentence}; from there on it counts as another placement")
            self._split(change.board, change.after)
            self.begin()
        return problem.with_huber(HUBER), fit.state

    def _refuse_slip(self, state: Estimate) -> None:
        """Raise if a board that seems to have moved turned about the pan axis: then it was pan that
        slipped."""
        rover_from_mast = state.as_mast.rover_from_mast
        for before, moved, after in self.split:
            poses = [rover_from_mast.inverse @ state.rover_from_board[b] for b in (before, moved)]
            motion = poses[1] @ poses[0].inverse
            turn = Rotation.from_matrix(motion.rotation).as_rotvec()
            aside = np.linalg.norm(turn[:2]) + np.linalg.norm(motion.translation_m)
            if abs(turn[2]) > SLIP_RAD and aside < SLIP_ASIDE * abs(turn[2]):
                raise BenchNotFitted(
                    f"pan slipped by about {1e3 * abs(turn[2]):.0f} mrad before picture {after}: the head "
                    "no longer "
                    "points where it read before; tighten what holds it on its axis and take the "
                    "pictures again"
                )

    def _split(self, board: tuple[str, str], after: str) -> None:
        """Give the images of a board from one on a placement of their own."""
        names = [i.name for i in self.survey.images]
        first = names.index(after)
        moved = (board[0], f"{board[1]} from {after} on")
        self.split.append((board, moved, after))

        def relabelled(terms: Sequence[ImageTerm]) -> tuple[ImageTerm, ...]:
            return tuple(
                replace(t, board=moved) if t.board == board and names.index(t.name) >= first else t
                for t in terms
            )

        self.terms = replace(
            self.terms, images=relabelled(self.terms.images), checks=relabelled(self.terms.checks)
        )

    def _views(self) -> dict[str, ViewPoses]:
        """What each camera says by itself."""
        views = {}
        for name, camera in self.cameras.items():
            mine = [t for t in self.terms.images if t.camera == name]
            try:
                views[name] = view_poses(
                    mine, self.options.kind or camera.kind, camera.size_px, camera.focal_px or None
                )
            except ViewsTooFew as error:
                raise BenchNotFitted(f"camera {name}: {error}") from None
        return views

    def _in_rover(self, state: Estimate) -> Estimate:
        """The start, which is in the mast's frame, carried to where the rover frame was chosen to be."""
        options, known = self.options, self.options.rover_from_board
        state = replace(state, bows_m={b: np.zeros(2) for b, _ in state.rover_from_board})
        if known is not None and known[0] not in state.rover_from_board:
            there = ", ".join("/".join(board) for board in state.rover_from_board)
            raise BenchNotFitted(
                f"no picture shows the board {'/'.join(known[0])} that is known; there are {there}"
            )
        rover_from_mast = options.rover_from_mast
        if known is not None:
            rover_from_mast = known[1] @ state.rover_from_board[known[0]].inverse
        if rover_from_mast is None:
            return state
        angles = Rotation.from_matrix(rover_from_mast.rotation).as_euler("XYZ")
        mast = np.array([*rover_from_mast.translation_m, *angles, *state.mast[6:]])
        boards = {b: rover_from_mast @ pose for b, pose in state.rover_from_board.items()}
        cameras = {
            n: m.moved(rover_from_mast) if self.cameras[n].on == "rover" else m
            for n, m in state.cameras.items()
        }
        if known is not None:
            boards[known[0]] = known[1]
        return replace(state, cameras=cameras, mast=mast, rover_from_board=boards)

    def problem(self, chosen: Sequence[str], state: Estimate) -> Adjustment:
        """The least-squares problem with some terms."""
        known = self.options.rover_from_board
        axes = [i for i, term in zip(AXES, AXIS_TERMS, strict=True) if term in chosen]
        return Adjustment(
            with_kept(self.terms.images, self.doubtful),
            (),
            state,
            mast_parameters=[*(() if known is None else range(6)), *axes],
            joint_rad=self.joint_rad,
            joint_errors=joint_numbers(chosen),
            bowed=[b for b in self.boards if f"bow of {b}" in chosen],
            held=() if known is None else (known[0],),
            huber=HUBER,
        )

    def candidates(self) -> tuple[str, ...]:
        """Terms that pictures could tell: backlash only where the axis came from both sides."""
        found = []
        approaches = np.array([t.approach for t in self.terms.images if t.attitude is not None])
        for term in candidate_terms(self.boards):
            axis = 0 if term.startswith("pan") else 1
            if term.endswith("backlash") and not {-1, 1} <= set(approaches[:, axis].tolist()):
                self.notes.append(
                    f"{term} cannot be told: {('pan', 'tilt')[axis]} did not come to rest from both sides"
                )
                continue
            found.append(term)
        return tuple(found)

    def calibration(self, began: float) -> BenchCalibration:
        """Fit everything, choose, fit again, and put together what it says."""
        told = chosen = tuple(self.options.terms or ())
        tests: dict[str, Tested] = {}
        every = self.candidates()
        problem, start = self.look_for_changes(every)
        choose = self.options.terms is None
        if choose:
            problem, fit = without_blunders(problem, start, self.terms.images)
            start, told = fit.state, every
            chosen, tests = self.choose(every, problem, fit)
        start = without_terms(start, set(every) - set(chosen))
        last = self.problem(chosen, start).with_terms(problem.images, ())
        problem, fit = without_blunders(last, start, self.terms.images, bounded=not choose)
        _refuse_far(problem, fit.state)
        weighed = weigh(problem, fit, self.terms.images)
        if not weighed.fit.settled:
            raise BenchNotFitted(
                f"the fit did not settle: after {weighed.fit.steps} steps it was still finding better "
                "values, so that neither they nor their sigmas are good; take more pictures, at more pan "
                "and tilt angles and distances"
            )
        return self._told((problem, fit), weighed, told, chosen, tests, began)

    def seen(self, chosen: Sequence[str], start: Estimate) -> Adjustment:
        """The problem without images whose corners have no pixel at the start."""
        problem = self.problem(chosen, start)
        unseen = {t.name for t in problem.images if not np.isfinite(problem.image_residual(start, t)).all()}
        return problem.with_terms(with_kept(problem.images, unseen), ())

    def choose(
        self, candidates: Sequence[str], problem: Adjustment, fit: Minimum[Estimate]
    ) -> tuple[tuple[str, ...], dict[str, Tested]]:
        """The terms that are significant, and every term's test."""
        covariance = covariance_of(fit.normal.matrix, problem.weak)
        total, freedom = goodness(problem, fit.state, covariance)
        every = candidate_terms(self.boards)
        values = _values(fit.state)
        return choose_terms(
            {term: every[term] for term in candidates},
            problem.names,
            values,
            covariance,
            total / max(freedom, 1.0),
            max(freedom, 1.0),
            term_motions(problem, fit.state, {term: every[term] for term in candidates}),
        )

    def _told(
        self,
        stated: tuple[Adjustment, Minimum[Estimate]],
        weighed: Weighed,
        candidates: Sequence[str],
        chosen: Sequence[str],
        tests: Mapping[str, Tested],
        began: float,
    ) -> BenchCalibration:
        """Put together what the fit says; chi-square is that of the stated sigmas."""
        problem, state, covariance = weighed.problem, weighed.fit.state, weighed.covariance
        total, freedom = goodness(*_at_fit(stated))
        for one in weighed.components:
            if one.wrong:
                self.notes.append(
                    f"{one.kind} are off by {one.factor:.2f} ± {one.factor_sigma:.2f} times the stated "
                    "sigma; they count with that"
                )
        # A parameter that is not seen keeps what is weakly known of it, and is told as open.
        mine, whole = _orders(problem)
        rig = self._rig(state)
        known = _part(problem.names, covariance, mine)
        sigma = sigma_by_key(rig, known.names, known.covariance)
        images = image_residuals(self.survey, problem, state, weighed.images, self.terms.checks)
        size = problem.parts[MAST].stop
        return BenchCalibration(
            rig=rig,
            parameter_names=known.names,
            covariance=known.covariance,
            unknowns=_part(problem.names, covariance, whole),
            sigma=sigma,
            terms=self._gains(candidates, chosen, tests, problem, state),
            rms_px=rms_by_camera(images),
            check_rms_px=rms_by_camera(_checked(images, self.terms.checks)),
            check_expected_px=self._expected(problem, state, covariance),
            images=images,
            outliers=name_outliers(problem, state, covariance, weighed.images),
            false_alarms=2 * FALSE_ALARMS,
            degenerate=open_directions(problem, problem.names[:size], covariance[:size, :size]),
            gauges=self._gauges(chosen),
            notes=(*self.notes, *lens_notes(rig, sigma)),
            chi2=total,
            degrees_of_freedom=freedom,
            chi2_probability=float(chi2.sf(total, freedom)) if freedom > 0 else float("nan"),
            components=weighed.components,
            joint_rad=problem.joint_rad,
            rover_from_board=state.rover_from_board,
            bows_m=state.bows_m,
            seconds=time.perf_counter() - began,
        )

    def _expected(
        self, problem: Adjustment, state: Estimate, covariance: FloatArray
    ) -> dict[str, tuple[float, float]]:
        """By camera what check images should be off by, rms per axis, and the most that chance allows."""
        squares: dict[str, list[FloatArray]] = {}
        exact = problem.at_rest()
        for term in self.terms.checks:
            block = exact.image_block(state, term)
            moved = [block.jacobian @ _root(covariance[np.ix_(block.columns, block.columns)])]
            if term.attitude is not None and problem.joint_rad > 0:
                moved.append(problem.joint_rad * reading_rates(exact, state, term))
            rates = np.repeat(term.sigma_px, 2)[:, None] * np.concatenate(moved, axis=1)
            # What moves a whole image counts once for it, not once for every corner.
            together = np.linalg.svd(rates, compute_uv=False) ** 2
            own = float(np.sum(np.repeat(term.sigma_px, 2) ** 2))
            found = squares.setdefault(term.camera, [])
            found.append(
                np.array([2.0 * len(term.sigma_px), own, float(together.sum()), float(np.sum(together**2))])
            )
        expected = {}
        for camera, found in squares.items():
            count, own, shared, fourth = np.sum(found, axis=0)
            mean, spread = (own + shared) / count, np.sqrt(2 * fourth + 2 * own**2 / count) / count
            expected[camera] = (float(np.sqrt(mean)), float(np.sqrt(mean + CHECK_SIGMAS * spread)))
        return expected

    def _rig(self, state: Estimate) -> Rig:
        cameras = {n: RigCamera(self.survey.cameras[n].on, m) for n, m in state.cameras.items()}
        stereo = {p: pair for p, pair in self.survey.stereo.items() if set(pair) <= set(cameras)}
        name = self.survey.folder.name or "calibrated"
        return Rig(name, state.as_mast, cameras, stereo, joints=state.as_joints)

    def _gains(
        self,
        candidates: Sequence[str],
        chosen: Sequence[str],
        tests: Mapping[str, Tested],
        problem: Adjustment,
        state: Estimate,
    ) -> tuple[TermGain, ...]:
        """Every term with what it gains."""
        every = candidate_terms(self.boards)
        _, now = self.choose(chosen, problem, Minimum(state, problem.with_huber(None).normal(state), True, 0))
        moves = moves_px(problem, state, {term: every[term] for term in chosen}, _values(state))
        found = []
        for term in candidates:
            test = now[term] if term in chosen else tests[term]
            found.append(
                TermGain(
                    term, term in chosen, every[term], test.values, test.sigma, test.chi2, test.chance,
                    moves.get(term, float("nan")),
                )
            )  # fmt: skip
        return tuple(found)

    def _gauges(self, chosen: Sequence[str]) -> tuple[str, ...]:
        """What pictures cannot know, and how it was fixed."""
        known = self.options.rover_from_board
        if known is not None:
            where = (
                f"the rover frame hangs on placement {known[0][1]} of board {known[0][0]}, whose pose was "
                "stated"
            )
        elif self.options.rover_from_mast is not None:
            where = "the mast stands in the rover frame as was stated, with no uncertainty"
        else:
            where = (
                "the rover frame is the mast's at zero angles (z down along the pan axis): where the "
                "vehicle is, pictures cannot tell"
            )
        told = [
            where,
            "its origin is where the pan axis is nearest to the tilt axis: pictures tell no other height "
            "along it",
            "pan is zero where the tilt axis points to y, tilt where the head's x lies square to pan: an "
            "offset of either would turn the frame or all head cameras, and is none",
            "every length is as long as the boards were measured: 0.1 % there is 0.1 % of every range",
        ]
        if "tilt harmonic 1" in chosen:
            told.append(
                "the first harmonic of tilt is encoder and an arm's sag together: pictures cannot tell them "
                "apart"
            )
        return tuple(told)


def _at_fit(
    stated: tuple[Adjustment, Minimum[Estimate]],
) -> tuple[Adjustment, Estimate, FloatArray]:
    """A problem, its fit's state, and the covariance there."""
    problem, fit = stated
    return problem, fit.state, covariance_of(fit.normal.matrix, problem.weak)


def _without_lone_strays(problem: Adjustment, state: Estimate) -> Adjustment:
    """Leave out corners far off in images of which most corners are less so."""
    terms = []
    for t in problem.images:
        if not t.keep.any():
            terms.append(t)
            continue
        length = np.linalg.norm(problem.image_residual(state, t).reshape(-1, 2), axis=1)
        keep = t.keep.copy()
        keep[keep] = length < LONE * max(float(np.median(length)), 1.0)
        terms.append(replace(t, keep=keep))
    return problem.with_terms(terms, ())


def without_terms(state: Estimate, terms: set[str]) -> Estimate:
    """Return the state with some terms' numbers at nothing."""
    mast, errors = state.mast.copy(), state.joint_errors.copy()
    mast[[i for i, term in zip(AXES, AXIS_TERMS, strict=True) if term in terms]] = 0.0
    errors[joint_numbers([term for term in terms if term.startswith(("pan ", "tilt "))])] = 0.0
    bows = {b: np.zeros(2) if f"bow of {b}" in terms else bow for b, bow in state.bows_m.items()}
    return replace(state, mast=mast, joint_errors=errors, bows_m=bows)


def _values(state: Estimate) -> dict[str, float]:
    """The values of all terms' numbers by their names."""
    values = dict(zip(JOINTS_NAMES, state.joint_errors.tolist(), strict=True))
    values |= {f"mast.{MAST_NAMES[i]}": float(state.mast[i]) for i in AXES}
    for board, bow in state.bows_m.items():
        values |= {f"board {board}.bow_m.{a}": float(b) for a, b in zip("xy", bow, strict=True)}
    return values


def _checked(images: Sequence[ImageResiduals], checks: Sequence[ImageTerm]) -> list[ImageResiduals]:
    """The check images, less corners that disagree with the rest of their own image."""
    strays = {t.name: stray_points(t.in_board_m[:, :2], t.pixels_px, t.sigma_px) for t in checks}
    return [
        replace(i, used=np.isfinite(i.residuals_px).all(axis=1) & ~strays[i.name])
        for i in images
        if i.name in strays
    ]


def _root(covariance: FloatArray) -> FloatArray:
    """A square root of a covariance."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _orders(problem: Adjustment) -> tuple[list[int], list[int]]:
    """Indices of the rig's parameters, mast first, joints, cameras; and of these with boards behind."""
    first = {"mast": 0, "joints": 1, "cameras": 2}
    owner = [name.split(".")[0] for name in problem.names]
    mine = sorted((i for i, o in enumerate(owner) if o in first), key=lambda i: (first[owner[i]], i))
    boards = [i for i, o in enumerate(owner) if o.startswith(("placement ", "board "))]
    return mine, [*mine, *boards]


def _part(names: Sequence[str], covariance: FloatArray, at: Sequence[int]) -> RigCovariance:
    return RigCovariance(tuple(names[i] for i in at), covariance[np.ix_(at, at)])


def _refuse_far(problem: Adjustment, state: Estimate) -> None:
    """Raise if a camera's typical corner is far above its noise, or too many images were left out."""
    for name in state.cameras:
        mine = [t for t in problem.images if t.camera == name]
        kept = [t for t in mine if t.keep.any()]
        if len(kept) < max(2, len(mine) // 2):
            raise BenchNotFitted(
                f"camera {name}: {len(mine) - len(kept)} of its {len(mine)} pictures do not agree with the "
                "rest; check that pan counts right and tilt up, that each picture's placement is the right "
                "one, and that nothing but the head moved"
            )
        lengths = [np.linalg.norm(problem.image_residual(state, t).reshape(-1, 2), axis=1) for t in kept]
        typical = float(np.median(np.concatenate(lengths))) / np.sqrt(chi2.median(2))
        if typical > WRONG_MINIMUM:
            noise = np.median(np.concatenate([t.sigma_px for t in kept]))
            raise BenchNotFitted(
                f"camera {name}: the fit leaves {typical:.1f} times the stated noise of a corner ({noise:g} "
                "px): it ended in a wrong minimum, the board's measures are wrong, or the sigmas are too "
                "small"
            )
