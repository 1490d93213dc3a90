"""Which board an image shows that contradicts the one that it names."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calib.adjust.result import Calibration, ImageResiduals
from calib.survey.records import Survey

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
