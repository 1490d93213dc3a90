"""What images that were not fitted say: how far off a survey's own noise lets them be, and which board they
show."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri

from calib.adjust.result import Calibration, ImageResiduals
from calib.adjust.terms import DOTS_OF, JOINTS, PRISMS, TAPES
from calib.adjust.uncertainty import pixel_covariance
from calib.geometry.rigid import FloatArray, rigid_rates
from calib.geometry.significance import Level
from calib.survey.alignment import Alignment, NotAligned, rover_from_station, station_from_board
from calib.survey.records import Survey


class CheckSize(NamedTuple):
    """Rms per axis of what was seen, and of what noise and the covariance of the fit make of it; pixels.

    ``limit_px`` is passed once in a thousand times, if the sigmas are right; ``chance`` is that of more than
    was seen.
    """

    seen_px: float
    expected_px: float
    limit_px: float
    chance: float


def check_sizes(survey: Survey, calibration: Calibration) -> dict[str, CheckSize]:
    """Return by camera how large the residuals of its check images are, and what would explain them.

    Their boards stand as the station measured them, and one board's error moves all its dots together: a
    board counts as two measurements, not as two hundred, and the near ones, which move most, for most of
    all (Satterthwaite's degrees of freedom).
    """
    try:
        setups = rover_from_station(_with_station(survey, calibration.widened(PRISMS)))
        boards = station_from_board(_with_station(survey, calibration.widened(TAPES)))
    except NotAligned:
        return {}
    squares: dict[str, list[tuple[float, float]]] = {}
    for image in calibration.images:
        key = (image.setup, image.placement)
        known = key in boards and image.setup in setups
        if image.purpose == "check" and known and np.isfinite(image.residuals_px).all():
            seen = float(np.mean(image.residuals_px**2))
            expected = _expected_px2(survey, calibration, image, setups[image.setup], boards[key])
            squares.setdefault(image.camera, []).append((seen, expected))
    sizes = {}
    for camera, pairs in squares.items():
        seen, expected = np.sqrt(np.mean(pairs, axis=0))
        each = np.array([part for _, part in pairs])
        freedom = 2 * each.sum() ** 2 / np.sum(each**2)
        limit = expected * np.sqrt(chdtri(freedom, float(Level.STATED)) / freedom)
        rarer = float(chdtrc(freedom, freedom * (seen / expected) ** 2))
        sizes[camera] = CheckSize(float(seen), float(expected), float(limit), rarer)
    return sizes


def _with_station(survey: Survey, factor: float) -> Survey:
    """The survey with the station's sigma as the fit takes it."""
    return replace(survey, sigma=replace(survey.sigma, station_m=factor * survey.sigma.station_m))


def _expected_px2(
    survey: Survey, calibration: Calibration, image: ImageResiduals, setup: Alignment, board: Alignment
) -> float:
    """Mean square per axis that dots, tapes and the fit's covariance explain.

    What prisms got wrong turns and shifts rig and board together and shows in no residual: it is taken out
    of the fit's covariance again.
    """
    pan, tilt = image.pan_rad or 0.0, image.tilt_rad or 0.0
    in_board = survey.board.dots_in_board_m(image.rows, image.columns)
    points = calibration.rover_from_board[image.setup, image.placement].points(in_board)
    model = calibration.rig.camera_in_rover(image.camera, pan, tilt)
    _, rates, _ = model.project_jacobian(points)
    in_station = rigid_rates(rates @ setup.b_from_a.rotation, board.b_from_a.vectors(in_board), np.zeros(3))
    by_board = np.einsum("nip,pq,niq->ni", in_station, board.covariance, in_station)
    in_rover = rigid_rates(rates, points, setup.b_from_a.translation_m)
    common = np.einsum("nip,pq,niq->ni", in_rover, setup.covariance, in_rover)
    _, by_fit = pixel_covariance(calibration, image.camera, pan, tilt, points)
    dots = calibration.widened(DOTS_OF + image.camera) * image.scatter
    by_joints = _by_joints_px2(calibration, image, points, survey.sigma.joint_rad)
    relative = np.maximum(np.einsum("nii->ni", by_fit) - common, 0.0)
    return float(np.nanmean(by_board + relative + by_joints + (dots * image.sigma_px[:, None]) ** 2))


def _by_joints_px2(
    calibration: Calibration, image: ImageResiduals, points_m: FloatArray, joint_rad: float
) -> FloatArray:
    """Variances (n, 2) that errors of a check image's own joint readings make: it has no part in the fit."""
    found = np.zeros((len(points_m), 2))
    if image.pan_rad is None or image.tilt_rad is None or joint_rad == 0.0:
        return found
    sigma_rad = calibration.widened(JOINTS) * joint_rad
    for pan, tilt in ((sigma_rad, 0.0), (0.0, sigma_rad)):
        ends = [
            calibration.rig.camera_in_rover(
                image.camera, image.pan_rad + sign * pan, image.tilt_rad + sign * tilt
            ).project(points_m)[0]
            for sign in (1, -1)
        ]
        found += ((ends[0] - ends[1]) / 2) ** 2
    return found


CLOSER = 0.1
"""Another board is the one that is shown if it fits the image so many times better than its own."""

FAR_PX = 20.0
"""The same where the image's own board has no pixels to compare with."""

Placement = tuple[str, str]


def exchanged_boards(survey: Survey, calibration: Calibration) -> Iterator[str]:
    """Yield a sentence for each two placements that were exchanged, and for each image of a wrong placement.

    Looked at are check images and images that the fit left out; tried is every board of their set-up, where
    the fit has it.
    """
    left_out = {outlier.name for outlier in calibration.outliers if outlier.kind == "image"}
    shown: dict[tuple[Placement, Placement], list[str]] = {}
    for image in calibration.images:
        if image.purpose == "check" or f"image {image.name}" in left_out:
            other = _shown(survey, calibration, image)
            if other is not None:
                shown.setdefault(((image.setup, image.placement), other), []).append(image.name)
    for (own, other), images in shown.items():
        back = shown.get((other, own))
        if back is None:
            yield (
                f"{_names(images)} cannot show placement {own[1]} but would show {other[1]} "
                f"(set-up {own[0]}): correct the placement in images.csv"
            )
        elif own < other:
            yield (
                f"the boards of placements {own[1]} and {other[1]} (set-up {own[0]}) seem to be exchanged: "
                f"{_names([*images, *back])} show the other one. Correct the names of the tapes in "
                "station.csv or the placements in images.csv"
            )


def _shown(survey: Survey, calibration: Calibration, image: ImageResiduals) -> Placement | None:
    """The board of the same set-up that the image shows; None if none fits far better than its own."""
    model = calibration.rig.camera_in_rover(image.camera, image.pan_rad or 0.0, image.tilt_rad or 0.0)
    in_board = survey.board.dots_in_board_m(image.rows, image.columns)
    own_px = float(np.sqrt(np.mean(image.residuals_px**2)))
    best, nearest_px = None, CLOSER * own_px if np.isfinite(own_px) else FAR_PX
    for placement, pose in calibration.rover_from_board.items():
        if placement[0] != image.setup or placement[1] == image.placement:
            continue
        predicted, valid = model.project(pose.points(in_board))
        if valid.all():
            rms_px = float(np.sqrt(np.mean((predicted - image.pixels_px) ** 2)))
            if rms_px < nearest_px:
                best, nearest_px = placement, rms_px
    return best


def _names(images: list[str], most: int = 4) -> str:
    more = f" and {len(images) - most} more" if len(images) > most else ""
    return ("image " if len(images) == 1 else "images ") + ", ".join(images[:most]) + more
