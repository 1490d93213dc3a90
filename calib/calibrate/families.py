"""Which camera model earns its parameters: families compared by pictures that their fits have not seen.

A camera with free boards is fitted to four fifths of its images; in each of the others the board's pose is
found from every second point, and the points between are predicted. A family of more numbers is worth them
if it predicts better by more than chance explains; else it only follows the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.adjust.adjustment import HUBER, Adjustment
from calib.adjust.solver import minimise
from calib.adjust.terms import ImageTerm
from calib.adjust.unknowns import Estimate
from calib.calibrate.starts.views import ViewPoses, ViewsTooFew, poses_of, view_poses
from calib.geometry.cahvor import CameraModel, Kind
from calib.geometry.parameters import parameter_names, predict
from calib.geometry.rigid import FloatArray, Rigid, moved_rigid, rigid_rates

FAMILIES: tuple[Kind, ...] = ("CAHV", "OPENCV4", "CAHVOR", "OPENCV5", "OPENCV8", "OPENCV_FISHEYE", "CAHVORE")
FOLDS = 5
EARNED_SIGMA = 3.0
"""A family is better if its gain is so many times what chance makes of it, over the images."""

LEAST_PART = 0.02
"""And if it predicts nearer by this part at least."""

MOST_IMAGES, MOST_POINTS = 20, 40
"""As many pictures, spread over all, and points of each, separate families."""

_STEPS = 8


@dataclass(frozen=True)
class FamilyScore:
    """One family.

    Attributes
    ----------
    kind, parameters
        The model, and how many numbers a camera of it has.
    left_out_px
        How far points of pictures that the fit has not seen are typically from their prediction, an axis,
        as one sigma.
    by_image_px2
        The typical square by image, pixels squared; not-a-number where the family gave none.
    """

    kind: Kind
    parameters: int
    left_out_px: float
    by_image_px2: tuple[float, ...]


def compare_families(
    images: Sequence[ImageTerm],
    size_px: tuple[int, int],
    focal_px: float | None,
    kinds: Sequence[Kind] = FAMILIES,
) -> tuple[FamilyScore, ...]:
    """Return how well each family predicts the images of one camera, in the order of ``kinds``.

    Parameters
    ----------
    images
        Of one camera; at least five, boards flat.
    size_px, focal_px
        Of the camera; the focal length may be some 20 % off.
    kinds
        Families; one that explains no images is left out.
    """
    some = np.unique(np.linspace(0, len(images) - 1, min(MOST_IMAGES, len(images))).astype(int))
    images = [_thinned(images[at]) for at in some]
    scores = []
    for kind in kinds:
        found = np.full(len(images), np.nan)
        for fold in range(FOLDS):
            seen = [term for at, term in enumerate(images) if at % FOLDS != fold]
            try:
                views = view_poses(seen, kind, size_px, focal_px)
                model = fitted_alone(seen, views)
            except ViewsTooFew:
                continue
            for at in range(fold, len(images), FOLDS):
                found[at] = _predicted_px2(model, images[at])
        if np.isfinite(found).any():
            left_out_px = float(np.sqrt(np.nanmedian(found)))
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
        gain = gain[np.isfinite(gain)]
        if len(gain) < 2 or other.left_out_px > (1.0 - LEAST_PART) * best.left_out_px:
            continue
        if float(gain.mean()) > EARNED_SIGMA * float(gain.std(ddof=1)) / np.sqrt(len(gain)):
            best = other
    return best


def fitted_alone(images: Sequence[ImageTerm], views: ViewPoses) -> CameraModel:
    """Return the camera that images with free boards say, begun where ``view_poses`` ended.

    Raises
    ------
    ViewsTooFew
        If fewer than three of them can be used.
    """
    terms = [term for term in images if term.name in views.poses and term.name not in views.doubtful]
    if len(terms) < 3:
        raise ViewsTooFew(f"{len(terms)} images can be used where at least 3 are expected")
    terms = [_alone(term, term.keep & ~views.strays[term.name]) for term in terms]
    poses = {term.board: views.poses[term.name][0] for term in terms}
    start = Estimate({terms[0].camera: views.model}, np.zeros(8), {}, poses, {}, np.zeros((0, 2)))
    problem = Adjustment(terms, (), start, mast_parameters=0, huber=HUBER)
    return minimise(problem, start, weak=problem.weak, steps=60).state.cameras[terms[0].camera]


def _thinned(term: ImageTerm) -> ImageTerm:
    """The picture with some of its points, spread over all."""
    kept = np.flatnonzero(term.keep)
    few = kept[np.linspace(0, len(kept) - 1, min(MOST_POINTS, len(kept))).astype(int)]
    keep = np.zeros_like(term.keep)
    keep[few] = True
    return replace(term, keep=keep)


def _alone(term: ImageTerm, keep: np.ndarray) -> ImageTerm:
    return replace(term, board=(term.name, ""), attitude=None, keep=keep)


def _predicted_px2(model: CameraModel, term: ImageTerm) -> float:
    """Typical square of a picture's odd points, its board placed by the even ones; not-a-number if lost."""
    found = poses_of(model, term)
    if not found:
        return float("nan")
    points, pixels, sigma = term.in_board_m[term.keep], term.pixels_px[term.keep], term.sigma_px[term.keep]
    even = np.arange(len(points)) % 2 == 0
    pose = _placed(model, found[0][1], points[even], pixels[even], sigma[even])
    off = model.project(pose.points(points[~even]))[0] - pixels[~even]
    squares = np.square(off[np.isfinite(off).all(axis=1)])
    return float(np.median(squares.sum(axis=1)) / (2.0 * np.log(2.0))) if len(squares) else float("nan")


def _placed(
    model: CameraModel, pose: Rigid, points_m: FloatArray, pixels_px: FloatArray, sigma_px: FloatArray
) -> Rigid:
    """The pose by Gauss and Newton's steps from one near it."""
    for _ in range(_STEPS):
        there = pose.points(points_m)
        seen = predict(model, there)
        good = seen.valid
        rates = rigid_rates(seen.d_points[good], there[good], pose.translation_m) / sigma_px[good, None, None]
        off = (seen.pixels_px[good] - pixels_px[good]) / sigma_px[good, None]
        step = -np.linalg.lstsq(rates.reshape(-1, 6), off.ravel(), rcond=None)[0]
        pose = moved_rigid(pose, step)
        if np.abs(step).max() < 1e-10:
            break
    return pose
