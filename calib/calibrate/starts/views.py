"""Where a board stood in front of a camera, image by image, with nothing known but a rough focal length.

A camera with free boards (Zhang 1999) starts from the rough focal length and ends with its own lens; each
image then gives camera_from_board (IPPE, Collins and Bartoli 2014), both of its solutions where a small or
distant board looks nearly the same from two sides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from calib.adjust.adjustment import Adjustment
from calib.adjust.gross import gross_limit
from calib.adjust.noise import without_wrong
from calib.adjust.terms import ImageTerm
from calib.adjust.unknowns import Estimate
from calib.calibrate.starts.agreeing import best_agreeing
from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel, Kind
from calib.geometry.rigid import Rigid

FEWEST_POINTS = 8
"""An image with fewer points takes no part in a start."""

IMAGES_FOR_LENS = 16
"""As many images, spread over all, are enough for a camera to start from."""


class ViewsTooFew(CalibError):
    """The images of a camera do not fix it: too few, or no lens explains them."""


@dataclass(frozen=True, eq=False)
class ViewPoses:
    """One camera by itself, with C at the origin and A along z.

    ``poses`` are by image name camera_from_board: the likeliest, and the other one if it is nearly as good.
    ``doubtful`` are images that no pose explains.
    """

    model: CameraModel
    poses: dict[str, tuple[Rigid, ...]]
    doubtful: frozenset[str]


def view_poses(
    images: Sequence[ImageTerm],
    kind: Kind,
    size_px: tuple[int, int],
    focal_px: float,
    *,
    images_for_lens: int = IMAGES_FOR_LENS,
) -> ViewPoses:
    """Return a camera and where the board, which is flat, stood in each of its images.

    The focal length may be some 20 % off. The lens is fitted to ``images_for_lens`` of the images at most.
    Raises ViewsTooFew if no camera explains the images.
    """
    clean = [t for t in without_wrong(images)[0] if t.keep.sum() >= FEWEST_POINTS]
    if not clean:
        raise ViewsTooFew(f"{len(images)} images, none of which shows {FEWEST_POINTS} corners of a board")
    spread = np.linspace(0, len(clean) - 1, min(images_for_lens, len(clean))).astype(int)
    some = [clean[i] for i in np.unique(spread)]
    models = (
        centred_camera(kind, size_px, focal, 2 if kind == "CAHVORE" else 0)
        for focal in (focal_px, 0.8 * focal_px, 1.25 * focal_px)
    )
    stated_px = float(np.median(np.concatenate([t.sigma_px for t in some])))
    best = best_agreeing((_free_boards(some, model) for model in models), stated_px)
    if best is None:
        raise ViewsTooFew("no lens explains where the corners are: check the board and its measures")
    # Boards that are free leave the camera's place open: put it back to where it began.
    model = best.fit.state.cameras[images[0].camera]
    model = model.moved(model.pose.inverse)
    poses, off = {}, {}
    for term in clean:
        found_poses = poses_of(model, term)
        if found_poses:
            poses[term.name] = tuple(pose for _, pose in found_poses)
            off[term.name] = found_poses[0][0]
    limit = gross_limit(list(off.values()), 1.0) if off else 0.0
    doubtful = {t.name for t in images if t.name not in off or off[t.name] > limit}
    return ViewPoses(model, poses, frozenset(doubtful))


def _free_boards(images: Sequence[ImageTerm], start: CameraModel) -> tuple[Adjustment, Estimate]:
    """A camera and boards of which every image shows one of its own, where a first guess of it has them."""
    placed = [(t, poses[0][1]) for t in images if (poses := poses_of(start, t))]
    terms = [replace(t, board=(t.name, ""), attitude=None) for t, _ in placed]
    boards = {(t.name, ""): pose for t, pose in placed}
    state = Estimate({images[0].camera: start}, rover_from_board=boards)
    return Adjustment(terms, (), state, mast_parameters=0), state


def centred_camera(
    kind: Kind, size_px: tuple[int, int], focal_px: float, cahvore_type: int = 0
) -> CameraModel:
    """Return a camera without distortion at the origin, its axis along z (``cahvore_type`` 2: a fish-eye)."""
    x, y, z = np.eye(3)
    cx, cy = (np.array(size_px) - 1) / 2
    h, v = focal_px * x + cx * z, focal_px * y + cy * z
    return CameraModel(kind, size_px, np.zeros(3), z, h, v, cahvore_type=cahvore_type)


def poses_of(model: CameraModel, term: ImageTerm) -> list[tuple[float, Rigid]]:
    """Return poses camera_from_board and how many sigmas their median corner is off, the best first."""
    keep = term.keep
    ahead = model.ray(term.pixels_px[keep]).directions
    some = np.isfinite(ahead).all(axis=1) & (ahead[:, 2] > 0.1)
    if some.sum() < 4:
        return []
    points = term.in_board_m[keep][some]
    slopes = ahead[some, :2] / ahead[some, 2:]
    middle = points.mean(axis=0)
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(
            points - middle, slopes[:, None, :], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:
        return []
    found = []
    for turn, shift in zip(turns, shifts, strict=True):
        turn, shift = cv2.solvePnPRefineLM(points - middle, slopes[:, None, :], np.eye(3), None, turn, shift)
        if not (np.isfinite(turn).all() and np.isfinite(shift).all()):
            continue
        rotation = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
        pose = Rigid(rotation, shift.ravel() - rotation @ middle)
        pixels, valid = model.project(pose.points(term.in_board_m[keep]))
        if not valid.any() or valid.mean() < 0.9:
            continue
        off = (pixels - term.pixels_px[keep])[valid] / term.sigma_px[keep][valid, None]
        found.append((float(np.sqrt(np.median(np.sum(off**2, axis=1)))), pose))
    found.sort(key=lambda one: one[0])
    limit = gross_limit([off for off, _ in found[:1]], 1.0) if found else 0.0
    return [one for one in found if one[0] <= limit]
