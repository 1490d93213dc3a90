"""From a survey to a place where least squares can start: set-ups, boards, cameras and mast in turn.

Each step takes the one before as exact, as the paper does, and is robust: a prism or tape that disagrees with
its drawing is left out of the start, and so is an image that belongs to another board. The fit's own test
judges again all that is left out here.

Cameras start from their rough focal length and the surveyed points alone (``calib.calibrate.starts.camera``).
A camera's rough place and direction are not used: they help to find dots (``calib.survey.find_dots``) and to
see what was mixed up (``calib.survey.mixups``), while a fit that needed them would hide that they are wrong.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.adjust.outliers import Outlier
from calib.adjust.robust import SurveyNotFitted
from calib.adjust.terms import ImageTerm, StationTerm, image_terms, station_terms
from calib.adjust.unknowns import Estimate
from calib.calibrate.starts.camera import CameraFit, CameraNotFitted, fit_camera
from calib.calibrate.starts.mast import MastNotFitted, MastView, fit_mast
from calib.calibrate.starts.station import station_poses
from calib.calibrate.starts.stray_dots import without_stray_dots
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import MAST_NAMES, mast_of
from calib.geometry.rigid import FloatArray, Rigid
from calib.survey.alignment import NotAligned
from calib.survey.records import Survey

SAME_ANGLE_RAD = 1e-3
"""Joint readings this close are one joint setting for a start."""


@dataclass(frozen=True, eq=False)
class Start:
    """A start: terms of the fit, the state to begin with, and images that did not agree with it.

    ``reference_rad`` holds, for each head camera, the joint setting at which it was calibrated, and
    ``in_rover`` the cameras there, in the rover frame. ``limits_px`` holds, for each camera, how far off (rms
    of the distances) the dots of an image may be that takes part. ``bent`` are placements whose tapes do not
    fit the board, ``blunders`` prisms and tapes that the poses were found without. ``kept`` holds, for images
    with stray dots, which of their dots the start was made with; ``stray_checks`` are those of check images,
    which lose them for good.
    """

    images: tuple[ImageTerm, ...]
    checks: tuple[ImageTerm, ...]
    station: tuple[StationTerm, ...]
    estimate: Estimate
    doubtful: frozenset[str]
    reference_rad: Mapping[str, tuple[float, float]]
    in_rover: Mapping[str, CameraModel]
    expected_px: Mapping[str, float]
    limits_px: Mapping[str, float]
    bent: frozenset[tuple[str, str]]
    blunders: tuple[Outlier, ...]
    notes: tuple[str, ...]
    kept: Mapping[str, np.ndarray]
    stray_checks: tuple[Outlier, ...]


def start_values(survey: Survey, mast_parameters: int, *, only_camera_images: bool = False) -> Start:
    """Return where to start the fit of a survey.

    ``only_camera_images`` calibrates cameras from images of purpose ``camera`` alone, as the paper does.

    Raises
    ------
    SurveyNotFitted
        If a set-up, a camera or the mast cannot be started; the sentence says what is missing.
    """
    every = survey
    survey, strays = without_stray_dots(survey)
    try:
        station = station_poses(survey)
    except NotAligned as error:
        raise SurveyNotFitted(str(error)) from None
    notes, rover_from_board, bent = list(station.notes), station.rover_from_board, station.bent
    images, checks, joints = image_terms(survey, rover_from_board, notes)
    doubtful: set[str] = set()
    in_rover, reference, expected, limits = {}, {}, {}, {}
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
        fit = _camera(survey, name, group, rover_from_board, expected[name], doubtful)
        in_rover[name], limits[name] = fit.model, fit.limit_px
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
    images, kept = _with_strays(every, images, strays, rover_from_board)
    images = [t for t in images if t.camera in cameras]
    estimate = Estimate(
        cameras,
        mast,
        station.rover_from_station,
        rover_from_board,
        station.prisms_in_rover_m,
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
        limits,
        bent,
        station.blunders,
        tuple(notes),
        kept,
        tuple(o for o in strays if any(o.name.startswith(f"image {t.name} dot ") for t in checks)),
    )


def _with_strays(
    survey: Survey,
    images: Sequence[ImageTerm],
    strays: Sequence[Outlier],
    boards: Mapping[tuple[str, str], Rigid],
) -> tuple[list[ImageTerm], dict[str, np.ndarray]]:
    """The terms with the dots that the start was made without, and which dots it was made with."""
    if not strays:
        return list(images), {}
    whole = {t.name: t for t in image_terms(survey, boards, [])[0]}
    kept = {}
    for term in images:
        if len(whole[term.name].rows) > len(term.rows):
            with_these = set(zip(term.rows.tolist(), term.columns.tolist(), strict=True))
            places = zip(whole[term.name].rows.tolist(), whole[term.name].columns.tolist(), strict=True)
            kept[term.name] = np.array([place in with_these for place in places])
    return [whole[term.name] for term in images], kept


def at_setting(image: ImageTerm, setting_rad: tuple[float, float], joint_rad: float) -> bool:
    """Return whether an image's joint readings are a setting's, but for their noise."""
    off = np.abs(np.subtract((image.pan_rad, image.tilt_rad), setting_rad))
    return bool(off.max() <= max(SAME_ANGLE_RAD, 4 * joint_rad))


def _largest_setting(
    images: Sequence[ImageTerm], joint_rad: float
) -> tuple[tuple[float, float], list[ImageTerm]]:
    """The joint setting with the most images, and those."""
    best: tuple[tuple[float, float], list[ImageTerm]] = ((0.0, 0.0), [])
    for one in images:
        group = [t for t in images if at_setting(t, (one.pan_rad, one.tilt_rad), joint_rad)]
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
) -> CameraFit:
    """A camera in the rover frame at its reference setting."""
    camera = survey.cameras[name]
    placements = {t.board for t in group}
    if len(placements) < 2:
        where = " at one joint setting" if camera.on == "head" else ""
        raise SurveyNotFitted(
            f"camera {name} sees {len(placements)} boards{where} where at least 2, better 8, are expected: "
            "take more images of boards at two distances without moving the head"
        )
    points = {t.name: boards[t.board].points(t.in_board_m) for t in group}
    fit = camera_from_points(survey, name, group, points, expected_px)
    first = 0
    for term in group:
        if not fit.used[first : first + len(term.rows)].any():
            doubtful.add(term.name)
        first += len(term.rows)
    return fit


def camera_from_points(
    survey: Survey,
    name: str,
    group: Sequence[ImageTerm],
    points_m: Mapping[str, FloatArray],
    expected_px: float,
) -> CameraFit:
    """Return a camera fitted to the dots of some images, at ``points_m`` by image, in one frame.

    Raises
    ------
    SurveyNotFitted
        If no camera explains them.
    """
    camera = survey.cameras[name]
    try:
        return fit_camera(
            np.concatenate([points_m[t.name] for t in group]),
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


def _mast(
    images: Sequence[ImageTerm],
    in_rover: Mapping[str, CameraModel],
    reference: Mapping[str, tuple[float, float]],
    boards: Mapping[tuple[str, str], Rigid],
    bent: frozenset[tuple[str, str]],
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
