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
from dataclasses import dataclass, replace

import numpy as np

from calib.adjust.adjustment import Adjustment
from calib.adjust.outliers import Outlier
from calib.adjust.robust import SurveyNotFitted
from calib.adjust.terms import ImageTerm, StationTerm, image_terms, station_terms
from calib.adjust.unknowns import Estimate
from calib.calibrate.starts.agreeing import Agreed
from calib.calibrate.starts.camera import fit_camera
from calib.calibrate.starts.mast import References, fit_mast
from calib.calibrate.starts.station import StationPoses, station_poses
from calib.calibrate.starts.wrong_dots import without_wrong, wrong_dots
from calib.geometry.rig import MAST_NAMES
from calib.geometry.rigid import Rigid
from calib.survey.alignment import NotAligned
from calib.survey.records import Survey

SAME_ANGLE_RAD = 1e-3
"""Joint readings this close are one joint setting for a start."""


@dataclass(frozen=True, eq=False)
class Start:
    """Cameras and mast of a survey, each step taken as exact for the next: where the joint fit begins, and
    what the paper's fit is.

    Attributes
    ----------
    images, checks, fitted
        All images with every dot, check images without wrong ones, and the images with those dots that the
        steps were made with.
    camera_images
        Names of the images that cameras were fitted to.
    references
        The cameras in the rover frame at the joint setting at which they were calibrated.
    doubtful
        Images that did not agree, by name how far off (rms of distances, pixels) they may be.
    wrong
        Dots of all images that disagree with the rest of theirs.
    """

    images: tuple[ImageTerm, ...]
    fitted: tuple[ImageTerm, ...]
    checks: tuple[ImageTerm, ...]
    station: tuple[StationTerm, ...]
    camera_images: frozenset[str]
    estimate: Estimate
    references: References
    doubtful: Mapping[str, float]
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

    Raises
    ------
    SurveyNotFitted
        If a set-up, a camera or the mast cannot be started; the sentence says what is missing.
    """
    try:
        poses = station_poses(survey)
    except NotAligned as error:
        raise SurveyNotFitted(str(error)) from None
    notes, boards = list(poses.notes), poses.rover_from_board
    images, checks, joints = image_terms(survey, boards, notes)
    wrong, outliers = wrong_dots([*images, *checks])
    purposes = {i.name: i.purpose for i in survey.images}
    clean = [without_wrong(t, wrong) for t in images]
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
    doubtful = {name: limit for fit in fits for name, limit in fit.left_out.items()}
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
        doubtful |= fits[-1].left_out
    elif settings:
        notes.append("every head image was taken at one joint setting: the mast is not calibrated")
        mast[:3] = np.mean([in_rover[name].C for name in settings], axis=0)
    kept = {t.name: np.zeros_like(t.keep) if by_purpose else t.keep for t in clean}
    kept |= {t.name: t.keep for fit in fits for t in fit.images}
    images = [t for t in images if t.camera in in_rover]
    return Start(
        tuple(images),
        tuple(replace(t, keep=kept[t.name]) for t in clean if t.camera in in_rover),
        tuple(t.only(~wrong[t.name]) if t.name in wrong else t for t in checks if t.camera in in_rover),
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
        doubtful,
        poses,
        outliers,
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
