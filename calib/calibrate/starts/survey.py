"""From a survey to a place where least squares can start: set-ups, boards, cameras and mast in turn.

Each step takes the one before as exact, as the paper does, and is robust: a prism or tape that disagrees with
its drawing is left out of the start, and so is an image that belongs to another board. The fit's own test
judges again all that is left out here.

"If the CAD model of the prism positions is inaccurate, it needs to be refined iteratively at different total
station locations" (paper section III.B): here all set-ups and the drawing are one least-squares problem, a
generalised Procrustes alignment with the drawing as prior. The drawing also defines the rover frame, by the
mean of its prisms.

Cameras start from their rough focal length and the surveyed points (``calib.calibrate.starts.cameras``). A
camera's rough place and direction are not used: they help to find dots (``calib.survey.find_dots``) and to
see what was mixed up (``calib.survey.diagnoses``); a fit that needed them would hide that they are wrong.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calib.adjust.adjustment import Adjustment
from calib.adjust.gross import Outlier
from calib.adjust.noise import without_wrong
from calib.adjust.outliers import name_outliers
from calib.adjust.robust import SurveyNotFitted, judged
from calib.adjust.terms import ImageTerm, StationTerm, image_terms, station_terms
from calib.adjust.unknowns import Estimate
from calib.calibrate.starts.agreeing import Agreed
from calib.calibrate.starts.cameras import References, fit_camera, fit_mast
from calib.geometry.rig import MAST_NAMES
from calib.geometry.rigid import FloatArray, Rigid
from calib.geometry.significance import Level
from calib.survey.alignment import Alignment, NotAligned, rover_from_station, station_from_board
from calib.survey.records import Survey

SAME_ANGLE_RAD = 1e-3
"""Joint readings this close are one joint setting for a start."""


@dataclass(frozen=True, eq=False)
class StationPoses:
    """Poses of set-ups and boards from prisms and tapes alone.

    ``rover_from_board`` is by set-up and placement, of placements with three tapes; ``bent`` are those whose
    tapes do not fit the board, ``blunders`` prisms and tapes that the poses were found without.
    ``prisms_in_rover_m`` is refined where the drawing has a sigma.
    """

    rover_from_station: Mapping[str, Rigid]
    rover_from_board: Mapping[tuple[str, str], Rigid]
    prisms_in_rover_m: Mapping[str, FloatArray]
    bent: frozenset[tuple[str, str]]
    blunders: tuple[Outlier, ...]
    notes: tuple[str, ...]


def station_poses(survey: Survey) -> StationPoses:
    """Return the poses that prisms and tapes give, each placement's alone.

    Set-ups are taken each alone where the drawing of the prisms is exact, else together, as the paper does.
    Raises NotAligned, naming the set-up or placement whose points are too few or on one line, or if the
    set-ups stand too differently from the drawing.
    """
    alone = rover_from_station(survey, false_alarm=Level.GROSS)
    notes = [
        f"the prisms of set-up {setup} do not agree with their CAD positions: {pose.doubt}"
        for setup, pose in alone.items()
        if pose.doubt
    ]
    setups: Mapping[str, Rigid] = {setup: pose.b_from_a for setup, pose in alone.items()}
    prisms: Mapping[str, FloatArray] = survey.prisms_in_rover_m
    if survey.sigma.prism_cad_m > 0:
        setups, prisms, blunders = _together(survey, alone)
    else:
        blunders = [
            blunder
            for setup, pose in alone.items()
            for blunder in _left_out("prism", pose, f"of set-up {setup}")
        ]
    boards, bent = {}, set()
    for (setup, placement), pose in station_from_board(survey, false_alarm=Level.GROSS).items():
        where = f"of placement {placement} (set-up {setup})"
        boards[setup, placement] = setups[setup] @ pose.b_from_a
        blunders += _left_out("tape", pose, where)
        if pose.doubt:
            bent.add((setup, placement))
            notes.append(f"the tapes {where} do not agree with the board's: {pose.doubt}")
    return StationPoses(setups, boards, prisms, frozenset(bent), tuple(blunders), tuple(notes))


def _together(
    survey: Survey, alone: Mapping[str, Alignment]
) -> tuple[Mapping[str, Rigid], Mapping[str, FloatArray], list[Outlier]]:
    """Set-ups and prisms by all set-ups and the drawing together: an adjustment without images."""
    off = {(setup, name) for setup, pose in alone.items() for name in pose.rejected}
    station = [replace(t, keep=(t.setup, t.point) not in off) for t in station_terms(survey, {})]
    start = Estimate(
        rover_from_station={setup: pose.b_from_a for setup, pose in alone.items()},
        prisms_in_rover_m=survey.prisms_in_rover_m,
    )
    problem = Adjustment(
        (),
        station,
        start,
        mast_parameters=0,
        prisms_cad_m=survey.prisms_in_rover_m,
        prism_cad_m=survey.sigma.prism_cad_m,
    )
    problem, fit = judged(problem, start, ())
    if not fit.settled:
        raise NotAligned(
            f"the prisms' places did not settle in {fit.steps} steps: the set-ups stand too differently from "
            "the drawing; check the prisms' names and places"
        )
    blunders = list(name_outliers(problem, fit.state, ()))
    return fit.state.rover_from_station, fit.state.prisms_in_rover_m, blunders


def _left_out(kind: Literal["prism", "tape"], pose: Alignment, where: str) -> list[Outlier]:
    """The points that an alignment left out."""
    off_m = dict(zip(pose.names, np.linalg.norm(pose.residuals_m, axis=1).tolist(), strict=True))
    return [Outlier(kind, f"{kind} {name} {where}", off_m[name]) for name in pose.rejected]


@dataclass(frozen=True, eq=False)
class Start:
    """Cameras and mast of a survey, each step taken as exact for the next: where the joint fit begins, and
    what the paper's fit is.

    ``images`` are with every dot, ``fitted`` with those that the steps were made with, ``checks`` without
    wrong ones. Cameras were fitted to ``camera_images``; ``references`` has them in the rover frame at the
    joint setting at which they were calibrated. ``doubtful`` are images that did not agree, ``wrong`` dots of
    all images that disagree with the rest of theirs.
    """

    images: tuple[ImageTerm, ...]
    fitted: tuple[ImageTerm, ...]
    checks: tuple[ImageTerm, ...]
    station: tuple[StationTerm, ...]
    camera_images: frozenset[str]
    estimate: Estimate
    references: References
    doubtful: frozenset[str]
    poses: StationPoses
    wrong: tuple[Outlier, ...]
    notes: tuple[str, ...]

    def problem(self, survey: Survey, mast_parameters: int) -> Adjustment:
        """Return the least-squares problem of everything that the steps were made with."""
        return Adjustment(
            self.fitted,
            self.station,
            self.estimate,
            mast_parameters=mast_parameters if self.references.joints_rad else 0,
            prisms_cad_m=survey.prisms_in_rover_m,
            prism_cad_m=survey.sigma.prism_cad_m,
            joint_rad=survey.sigma.joint_rad,
        )


def start_values(survey: Survey, mast_parameters: int, *, by_purpose: bool = False) -> Start:
    """Return where to start the fit of a survey.

    ``by_purpose`` fits cameras to images of purpose ``camera`` and the mast to those of purpose ``mast``, all
    dots with one weight, as the paper does; else what was taken at one setting, and away from it, counts.

    Raises SurveyNotFitted if a set-up, a camera or the mast cannot be started, saying what is missing.
    """
    try:
        poses = station_poses(survey)
    except NotAligned as error:
        raise SurveyNotFitted(str(error)) from None
    notes, boards = list(poses.notes), poses.rover_from_board
    images, checks, joints = image_terms(survey, boards, notes)
    every, wrong = without_wrong([*images, *checks])
    clean, checks = every[: len(images)], every[len(images) :]
    purposes = {i.name: i.purpose for i in survey.images}
    if by_purpose:
        clean = [replace(t, sigma_px=np.full(len(t.rows), survey.sigma.dot_px)) for t in clean]
    usable = [t for t in clean if t.board not in poses.bent]
    fits: list[Agreed] = []
    in_rover, settings, expected = {}, dict[str, tuple[float, float]](), dict[str, float]()
    for name, camera in survey.cameras.items():
        mine = [t for t in usable if t.camera == name and (not by_purpose or purposes[t.name] == "camera")]
        if not mine and not any(t.camera == name for t in images):
            notes.append(f"camera {name} has no image with dots and is not calibrated")
            continue
        setting, group = _largest_setting(mine, survey.sigma.joint_rad)
        expected[name] = _expected_px(survey, name, group, boards)
        if not group:
            raise SurveyNotFitted(
                f"camera {name} has no image of purpose camera: take some at one joint setting"
            )
        fits.append(
            fit_camera(
                group, boards, kind=camera.kind, size_px=camera.size_px, focal_px=camera.focal_px,
                expected_px=expected[name],
            )
        )  # fmt: skip
        in_rover[name] = fits[-1].fit.state.cameras[name]
        if camera.on == "head":
            settings[name] = setting
    references = References(in_rover, settings)
    camera_images = frozenset(t.name for fit in fits for t in fit.images)
    doubtful = {t.name for fit in fits for t in fit.images if not t.keep.any()}
    # Cameras fitted to few boards are off by more, away from where these stood, than their own residuals.
    most = 3 * max((expected[name] for name in settings), default=0.0)
    mast = np.zeros(len(MAST_NAMES))
    away = [
        t
        for t in usable
        if t.camera in settings and t.name not in doubtful
        and (purposes[t.name] == "mast" if by_purpose else _apart(t, settings[t.camera]) > SAME_ANGLE_RAD)
    ]  # fmt: skip
    if away:
        fits.append(fit_mast(away, boards, references, mast_parameters, expected_px=most))
        mast = fits[-1].fit.state.mast
        doubtful |= {t.name for t in fits[-1].images if not t.keep.any()}
    elif settings:
        notes.append("every head image was taken at one joint setting: the mast is not calibrated")
        mast[:3] = np.mean([in_rover[name].C for name in settings], axis=0)
    kept = {t.name: np.zeros_like(t.keep) if by_purpose else t.keep for t in clean}
    kept |= {t.name: t.keep for fit in fits for t in fit.images}
    images = [t for t in images if t.camera in in_rover]
    return Start(
        tuple(images),
        tuple(replace(t, keep=kept[t.name]) for t in clean if t.camera in in_rover),
        tuple(t.only(t.keep) for t in checks if t.camera in in_rover),
        station_terms(survey, boards),
        camera_images,
        Estimate(
            references.in_head(mast),
            mast,
            poses.rover_from_station,
            boards,
            poses.prisms_in_rover_m,
            np.zeros((len(joints) if survey.sigma.joint_rad > 0 else 0, 2)),
        ),
        references,
        frozenset(doubtful),
        poses,
        wrong,
        tuple(notes),
    )


def _apart(image: ImageTerm, setting_rad: tuple[float, float]) -> float:
    """How far an image's joint readings are from a setting's, radians."""
    return float(np.abs(np.subtract((image.pan_rad, image.tilt_rad), setting_rad)).max())


def _largest_setting(
    images: Sequence[ImageTerm], joint_rad: float
) -> tuple[tuple[float, float], list[ImageTerm]]:
    """The joint setting with the most images (readings differ by their noise), and those."""
    best: list[ImageTerm] = []
    for one in images:
        most = max(SAME_ANGLE_RAD, 4 * joint_rad)
        group = [t for t in images if _apart(t, (one.pan_rad, one.tilt_rad)) <= most]
        best = max(best, group, key=len)
    pan, tilt = np.median([(t.pan_rad, t.tilt_rad) for t in best] or [(0.0, 0.0)], axis=0).tolist()
    return (pan, tilt), best


def _expected_px(
    survey: Survey, name: str, group: Sequence[ImageTerm], boards: Mapping[tuple[str, str], Rigid]
) -> float:
    """Residual to expect with boards taken as exact: the noise of station and dots, seen by the camera."""
    sigma, focal_px = survey.sigma, survey.cameras[name].focal_px
    prisms = np.mean(list(survey.prisms_in_rover_m.values()), axis=0)
    ranges = [np.linalg.norm(boards[t.board].translation_m - prisms) for t in group]
    typical = float(np.median(ranges)) if ranges else 1.0
    seen = focal_px * sigma.station_m / max(typical, 0.5)
    return float(np.sqrt(sigma.dot_px**2 + 1.5 * seen**2 + (focal_px * sigma.joint_rad) ** 2))
