"""From a survey to a place where least squares can start: set-ups, boards, cameras and mast in turn.

Each step takes the one before as exact, as the paper does, and is robust: a prism or tape that disagrees with
its drawing is left out of the start, and so is an image that belongs to another board. What is left out here
is judged again by the fit's own test.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from calib.adjustment import Estimate
from calib.cahvor import CameraModel
from calib.calibration import Outlier
from calib.errors import CalibError
from calib.fit_camera import CameraNotFitted, fit_camera
from calib.fit_mast import MastNotFitted, MastView, fit_mast
from calib.gimbal import MAST_NAMES, mast_of
from calib.rigid import FloatArray, Rigid
from calib.survey import Survey
from calib.terms import ImageTerm, StationTerm, image_terms, station_terms

SAME_ANGLE_RAD = 1e-3
"""Joint readings this close are one joint setting for a start."""

SHAPE = 5.0
"""Tapes or prisms that are off their drawing by more than this many sigmas are not trusted for a start."""


class SurveyNotFitted(CalibError):
    """The survey does not determine what is asked of it, or no start leads to its noise."""


@dataclass(frozen=True, eq=False)
class Start:
    """A start: terms of the fit, the state to begin with, and images that did not agree with it.

    ``reference_rad`` holds, for each head camera, the joint setting at which it was calibrated, and
    ``in_rover`` the cameras there, in the rover frame. ``bent`` are placements whose tapes do not fit the
    board, ``blunders`` prisms that the set-ups' poses were found without.
    """

    images: tuple[ImageTerm, ...]
    checks: tuple[ImageTerm, ...]
    station: tuple[StationTerm, ...]
    estimate: Estimate
    doubtful: frozenset[str]
    reference_rad: Mapping[str, tuple[float, float]]
    in_rover: Mapping[str, CameraModel]
    expected_px: Mapping[str, float]
    bent: frozenset[tuple[str, str]]
    blunders: tuple[Outlier, ...]
    notes: tuple[str, ...]


def start(survey: Survey, mast_parameters: int, *, only_camera_images: bool = False) -> Start:
    """Return where to start the fit of a survey.

    ``only_camera_images`` calibrates cameras from images of purpose ``camera`` alone, as the paper does.

    Raises
    ------
    SurveyNotFitted
        If a set-up, a camera or the mast cannot be started; the sentence says what is missing.
    """
    notes: list[str] = []
    blunders: list[Outlier] = []
    rover_from_station = _setups(survey, blunders, notes)
    rover_from_board, bent = _boards(survey, rover_from_station, notes)
    images, checks, joints = image_terms(survey, rover_from_board, notes)
    doubtful: set[str] = set()
    in_rover, reference, expected = {}, {}, {}
    for name in survey.cameras:
        mine = [t for t in images if t.camera == name and t.board not in bent]
        if only_camera_images:
            purposes = {i.name: i.purpose for i in survey.images}
            mine = [t for t in mine if purposes[t.name] == "camera"]
        if not mine and not any(t.camera == name for t in images):
            notes.append(f"camera {name} has no image with dots and is not calibrated")
            continue
        at, group = _largest_setting(mine, survey.sigma.joint_rad)
        expected[name] = _expected_px(survey, name, group, rover_from_board)
        in_rover[name] = _camera(survey, name, group, rover_from_board, expected[name], doubtful)
        if survey.cameras[name].on == "head":
            reference[name] = at
    mast = np.zeros(len(MAST_NAMES))
    if reference:
        mast = _mast(
            images, in_rover, reference, rover_from_board, bent, expected, mast_parameters, doubtful, notes
        )
    cameras = {}
    for name, model in in_rover.items():
        if name in reference:
            model = model.moved(mast_of(mast).rover_from_head(*reference[name]).inverse)
        cameras[name] = model
    images = [t for t in images if t.camera in cameras]
    estimate = Estimate(
        cameras,
        mast,
        rover_from_station,
        rover_from_board,
        {n: np.array(p) for n, p in survey.prisms_in_rover_m.items()},
        np.zeros((len(joints) if survey.sigma.joint_rad > 0 else 0, 2)),
    )
    return Start(
        tuple(images),
        tuple(t for t in checks if t.camera in cameras),
        station_terms(survey, rover_from_board),
        estimate,
        frozenset(doubtful),
        reference,
        in_rover,
        expected,
        frozenset(bent),
        tuple(blunders),
        tuple(notes),
    )


def aligned(to_m: FloatArray, from_m: FloatArray) -> Rigid:
    """Return the rigid transform that carries points (n, 3) best onto others (Kabsch)."""
    to_mean, from_mean = to_m.mean(axis=0), from_m.mean(axis=0)
    rotation, _ = Rotation.align_vectors(to_m - to_mean, from_m - from_mean)
    return Rigid(rotation.as_matrix(), to_mean - rotation.apply(from_mean))


class Alignment(NamedTuple):
    """An alignment, how many sigmas its worst coordinate is off, and the point left out, if any."""

    pose: Rigid
    misfit: float
    left_out: int | None


def _aligned_without_blunder(to_m: FloatArray, from_m: FloatArray, sigma_m: float) -> Alignment:
    """The alignment, without the one point (of four or more) whose leaving helps by far."""

    def without(row: int | None) -> Alignment:
        rows = np.array([i for i in range(len(to_m)) if i != row])
        pose = aligned(to_m[rows], from_m[rows])
        worst = float(np.abs(to_m[rows] - pose.points(from_m[rows])).max())
        return Alignment(pose, worst / sigma_m, row)

    found = without(None)
    if found.misfit <= SHAPE or len(to_m) < 4:
        return found
    return min((without(row) for row in range(len(to_m))), key=lambda a: a.misfit)


def _setups(survey: Survey, blunders: list[Outlier], notes: list[str]) -> dict[str, Rigid]:
    """rover_from_station of every set-up."""
    found = {}
    sigma = float(np.hypot(survey.sigma.station_m, survey.sigma.prism_cad_m))
    for setup in dict.fromkeys(p.setup for p in survey.station):
        prisms = [p for p in survey.station if p.setup == setup and p.kind == "prism"]
        prisms = [p for p in prisms if p.point in survey.prisms_in_rover_m]
        if len(prisms) < 3:
            raise SurveyNotFitted(
                f"set-up {setup} has {len(prisms)} prisms where at least 3 are expected: measure the prisms"
            )
        cad = np.array([survey.prisms_in_rover_m[p.point] for p in prisms])
        measured = np.array([p.position_m for p in prisms])
        pose, misfit, row = _aligned_without_blunder(cad, measured, sigma)
        found[setup] = pose
        if row is not None and misfit <= SHAPE:
            off = float(np.linalg.norm(pose.points(measured[row]) - cad[row]))
            name = f"prism {prisms[row].point} of set-up {setup}"
            blunders.append(Outlier("prism", name, (off / sigma) ** 2, SHAPE**2, off))
        elif misfit > SHAPE:
            notes.append(
                f"the prisms of set-up {setup} are off their CAD positions by {misfit:.0f} sigmas, and "
                "leaving out no single one helps: measure them again"
            )
    return found


def _boards(
    survey: Survey, rover_from_station: Mapping[str, Rigid], notes: list[str]
) -> tuple[dict[tuple[str, str], Rigid], set[tuple[str, str]]]:
    """rover_from_board of every placement with three tapes, and those whose tapes do not fit the board."""
    found, bent = {}, set()
    tapes: dict[tuple[str, str], list[tuple[FloatArray, FloatArray]]] = {}
    for p in survey.station:
        if p.kind == "tape" and p.point in survey.board.tapes_in_board_m:
            in_rover = rover_from_station[p.setup].points(p.position_m)
            pair = (in_rover, survey.board.tapes_in_board_m[p.point])
            tapes.setdefault((p.setup, p.placement), []).append(pair)
    for board, points in tapes.items():
        if len(points) < 3:
            continue
        measured, drawn = (np.array(part) for part in zip(*points, strict=True))
        pose, misfit, _ = _aligned_without_blunder(measured, drawn, survey.sigma.station_m)
        found[board] = pose
        if misfit > SHAPE:
            bent.add(board)
            notes.append(
                f"the tapes of placement {board[1]} (set-up {board[0]}) are off the board's by "
                f"{misfit:.0f} sigmas"
            )
    return found, bent


def _largest_setting(
    images: Sequence[ImageTerm], joint_rad: float
) -> tuple[tuple[float, float], list[ImageTerm]]:
    """The joint setting with the most images, and those."""
    near = max(SAME_ANGLE_RAD, 4 * joint_rad)
    best: tuple[tuple[float, float], list[ImageTerm]] = ((0.0, 0.0), [])
    for one in images:
        group = [
            t
            for t in images
            if abs(t.pan_rad - one.pan_rad) <= near and abs(t.tilt_rad - one.tilt_rad) <= near
        ]
        if len(group) > len(best[1]):
            pan = float(np.median([t.pan_rad for t in group]))
            tilt = float(np.median([t.tilt_rad for t in group]))
            best = ((pan, tilt), group)
    return best


def _expected_px(
    survey: Survey, name: str, group: Sequence[ImageTerm], boards: Mapping[tuple[str, str], Rigid]
) -> float:
    """Residual to expect with boards taken as exact: the noise of station and dots, seen by the camera."""
    sigma = survey.sigma
    prisms = np.mean(list(survey.prisms_in_rover_m.values()), axis=0)
    ranges = [np.linalg.norm(boards[t.board].translation_m - prisms) for t in group]
    typical = float(np.median(ranges)) if ranges else 1.0
    seen = survey.cameras[name].focal_px * sigma.station_m / max(typical, 0.5)
    turned = survey.cameras[name].focal_px * sigma.joint_rad
    return float(np.sqrt(sigma.dot_px**2 + 1.5 * seen**2 + turned**2))


def _camera(
    survey: Survey,
    name: str,
    group: Sequence[ImageTerm],
    boards: Mapping[tuple[str, str], Rigid],
    expected_px: float,
    doubtful: set[str],
) -> CameraModel:
    """A camera in the rover frame at its reference setting."""
    camera = survey.cameras[name]
    placements = {t.board for t in group}
    if len(placements) < 2:
        where = " at one joint setting" if camera.on == "head" else ""
        raise SurveyNotFitted(
            f"camera {name} sees {len(placements)} boards{where} where at least 2, better 8, are expected: "
            "take more images of boards at two distances without moving the head"
        )
    try:
        fit = fit_camera(
            np.concatenate([boards[t.board].points(t.in_board_m) for t in group]),
            np.concatenate([t.pixels_px for t in group]),
            np.concatenate([np.full(len(t.rows), i) for i, t in enumerate(group)]),
            kind=camera.kind,
            size_px=camera.size_px,
            focal_px=camera.focal_px,
            sigma_px=survey.sigma.dot_px,
            expected_px=expected_px,
        )
    except CameraNotFitted as error:
        raise SurveyNotFitted(f"camera {name}: {error}") from None
    first = 0
    for term in group:
        if not fit.used[first : first + len(term.rows)].any():
            doubtful.add(term.name)
        first += len(term.rows)
    return fit.model


def _mast(
    images: Sequence[ImageTerm],
    in_rover: Mapping[str, CameraModel],
    reference: Mapping[str, tuple[float, float]],
    boards: Mapping[tuple[str, str], Rigid],
    bent: set[tuple[str, str]],
    expected: Mapping[str, float],
    mast_parameters: int,
    doubtful: set[str],
    notes: list[str],
) -> FloatArray:
    """The mast's eight numbers."""
    views = mast_views(
        [t for t in images if t.board not in bent and t.name not in doubtful], in_rover, reference, boards
    )
    away = [v for v in views if np.abs(np.subtract(v.joints_rad, v.reference_rad)).max() > SAME_ANGLE_RAD]
    if not away:
        notes.append("every head image was taken at one joint setting: the mast is not calibrated")
        centre = np.mean([in_rover[name].C for name in reference], axis=0)
        return np.array([*centre, 0.0, 0.0, 0.0, 0.0, 0.0])
    # Cameras fitted to few boards are off by more, away from where these stood, than their own residuals.
    try:
        typical = 3 * max(expected[n] for n in reference)
        fit = fit_mast(away, mast_parameters, expected_px=typical, keep_all=mast_parameters == 4)
    except MastNotFitted as error:
        raise SurveyNotFitted(f"mast: {error}") from None
    doubtful.update(fit.left_out)
    return fit.mast


def mast_views(
    images: Sequence[ImageTerm],
    in_rover: Mapping[str, CameraModel],
    reference: Mapping[str, tuple[float, float]],
    boards: Mapping[tuple[str, str], Rigid],
) -> list[MastView]:
    """Return the head images as ``fit_mast`` wants them."""
    return [
        MastView(
            t.name,
            in_rover[t.camera],
            reference[t.camera],
            (t.pan_rad, t.tilt_rad),
            boards[t.board].points(t.in_board_m[t.keep]),
            t.pixels_px[t.keep],
        )
        for t in images
        if t.camera in reference
    ]
