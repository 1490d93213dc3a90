"""Which camera model earns its parameters: families compared by pictures that their fits have not seen.

A camera with free boards is fitted to four fifths of its images; in each of the others the board's pose is
found from every second point, and the points between are predicted. A family of more numbers is worth them
if it predicts better by more than chance explains; else it only follows the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.adjust.terms import ImageTerm
from calib.calibrate.starts.agreeing import thinned
from calib.calibrate.starts.views import ViewsTooFew, poses_of, view_poses
from calib.geometry.cahvor import CameraModel, Kind
from calib.geometry.parameters import parameter_names
from calib.geometry.significance import MEDIAN_OF_TWO

FAMILIES: tuple[Kind, ...] = ("CAHV", "OPENCV4", "CAHVOR", "OPENCV5", "OPENCV8", "OPENCV_FISHEYE", "CAHVORE")
FOLDS = 5
EARNED_SIGMA = 3.0
"""A family is better if its gain is so many times what chance makes of it, over the images."""

LEAST_PART = 0.02
"""And if it predicts nearer by this part at least."""

MOST_IMAGES, MOST_POINTS = 20, 40
"""As many pictures, spread over all, and points of each, separate families."""


@dataclass(frozen=True)
class FamilyScore:
    """One family, of so many numbers a camera.

    ``left_out_px`` is how far points of pictures that the fit has not seen are typically from their
    prediction, an axis, as one sigma, ``by_image_px2`` the typical square by image; not-a-number where the
    family gave none.
    """

    kind: Kind
    parameters: int
    left_out_px: float
    by_image_px2: tuple[float, ...]


def compare_families(
    images: Sequence[ImageTerm],
    size_px: tuple[int, int],
    focal_px: float,
    kinds: Sequence[Kind] = FAMILIES,
) -> tuple[FamilyScore, ...]:
    """Return how well each family predicts the images of one camera, in the order of ``kinds``.

    There are at least five images, of flat boards. The focal length may be some 20 % off. A family that
    explains no images is left out.
    """
    some = np.unique(np.linspace(0, len(images) - 1, min(MOST_IMAGES, len(images))).astype(int))
    images = [thinned(images[at], MOST_POINTS) for at in some]
    scores = []
    for kind in kinds:
        found = np.full(len(images), np.nan)
        for fold in range(FOLDS):
            seen = [term for at, term in enumerate(images) if at % FOLDS != fold]
            try:
                model = view_poses(seen, kind, size_px, focal_px, images_for_lens=len(seen)).model
            except ViewsTooFew:
                continue
            for at in range(fold, len(images), FOLDS):
                found[at] = _predicted_px2(model, images[at])
        if np.isfinite(found).any():  # a picture that a family cannot predict counts as infinitely far off
            left_out_px = float(np.sqrt(np.median(np.nan_to_num(found, nan=np.inf))))
            scores.append(FamilyScore(kind, len(parameter_names(kind)), left_out_px, tuple(found.tolist())))
    return tuple(scores)


def earned(scores: Sequence[FamilyScore], now: Kind) -> FamilyScore:
    """Return the family that predicts better than ``now`` by more than chance, the smallest; else ``now``.

    Without a score of ``now``, the comparison begins at the family of fewest parameters.
    """
    ordered = sorted(scores, key=lambda one: one.parameters)
    best = next((one for one in ordered if one.kind == now), ordered[0])
    for other in ordered:
        gain = np.log(np.array(best.by_image_px2)) - np.log(np.array(other.by_image_px2))
        if (np.isnan(other.by_image_px2) & np.isfinite(best.by_image_px2)).any():
            continue  # it loses a picture that the smaller one predicts
        gain = gain[np.isfinite(gain)]
        if len(gain) < 2 or other.left_out_px > (1.0 - LEAST_PART) * best.left_out_px:
            continue
        if float(gain.mean()) > EARNED_SIGMA * float(gain.std(ddof=1)) / np.sqrt(len(gain)):
            best = other
    return best


def _predicted_px2(model: CameraModel, term: ImageTerm) -> float:
    """Typical square of a picture's odd points, its board placed by the even ones; not-a-number if lost."""
    kept = np.flatnonzero(term.keep)
    even, odd = np.zeros_like(term.keep), kept[1::2]
    even[kept[::2]] = True
    poses = poses_of(model, replace(term, keep=even))
    if not poses or not len(odd):
        return float("nan")
    off = model.project(poses[0][1].points(term.in_board_m[odd]))[0] - term.pixels_px[odd]
    typical = float(np.median(np.nan_to_num(np.square(off).sum(axis=1), nan=np.inf)))
    return typical / MEDIAN_OF_TWO if np.isfinite(typical) else float("nan")
