"""Features of one picture found again in others: SIFT says which, least-squares matching says where.

A feature is a patch of the first picture that shows it (its anchor); everywhere else it is measured. SIFT's
own places scatter by some tenths of a pixel, so they only start the match (`calib.pictures.patch_match`),
on the patch as the rig foresees it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from calib.camera.cahvor import CameraModel
from calib.errors import CalibError
from calib.mast.rig import Rig
from calib.pictures.patch_match import match_patch
from calib.pictures.patch_verdict import MatchSettings
from calib.pictures.warp import Plane
from calib.rigid import FloatArray
from calib.scene.views import FARTHEST_M, LEAST_OVERLAP, NEAREST_M, View, overlap

MOST_KEYPOINTS = 3000
GATE_PX = 20.0
"""How far from its epipolar line a feature is looked for: what a bumped camera may be off."""

WINDOW_PX = 4.0
"""How far from SIFT's place the patch is matched."""

RATIO = 0.85
MARGIN_PX = 22.0
MOST_A_PAIR = 150
SAME_PX = 3.0
"""Keypoints nearer to a feature that is followed already are that feature."""

ANCHOR_SIGMA_PX = 0.02
FLOOR_SIGMA_PX = 0.04
"""Per axis: what matching leaves on real texture whatever its own covariance says."""

UP = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True, eq=False)
class Feature:
    """One feature: in which views (m,) it is, at which pixels (m, 2), with which covariance (m, 2, 2)."""

    views: tuple[int, ...]
    pixels_px: FloatArray
    covariances_px2: FloatArray


class _Keypoints(NamedTuple):
    pixels_px: FloatArray
    descriptors: np.ndarray


def find_features(rig: Rig, views: Sequence[View]) -> list[Feature]:
    """Return the features that at least two of the views show.

    Parameters
    ----------
    rig
        What is believed: good to some 20 px, or nothing is found.
    views
        Their pictures.
    """
    models = [view.model(rig) for view in views]
    keypoints = [_keypoints(view) for view in views]
    taken: list[list[FloatArray]] = [[] for _ in views]
    features: list[Feature] = []
    for first in range(len(views)):
        found: dict[int, list[tuple[int, FloatArray, FloatArray]]] = {}
        free = _free(keypoints[first].pixels_px, taken[first])
        for second in range(first + 1, len(views)):
            if (
                max(overlap(models[first], models[second]), overlap(models[second], models[first]))
                < LEAST_OVERLAP
            ):
                continue
            for keypoint, pixel, covariance in _pair(views, models, keypoints, first, second, free):
                found.setdefault(keypoint, []).append((second, pixel, covariance))
                taken[second].append(pixel)
        for keypoint, seen in found.items():
            features.append(
                Feature(
                    (first, *(view for view, _, _ in seen)),
                    np.array([keypoints[first].pixels_px[keypoint], *(pixel for _, pixel, _ in seen)]),
                    np.array([ANCHOR_SIGMA_PX**2 * np.eye(2), *(covariance for _, _, covariance in seen)]),
                )
            )
    return features


def _keypoints(view: View) -> _Keypoints:
    """SIFT's keypoints of a picture, away from its border, on whole pixels: a patch's middle."""
    image = np.clip(np.rint(view.image), 0, 255).astype(np.uint8)
    found, descriptors = cv2.SIFT.create(MOST_KEYPOINTS).detectAndCompute(image, None)
    if descriptors is None:
        return _Keypoints(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    pixels = np.rint([point.pt for point in found])
    height, width = image.shape
    inside = ((pixels >= MARGIN_PX) & (pixels <= np.array([width, height]) - 1 - MARGIN_PX)).all(axis=1)
    _, once = np.unique(pixels[inside], axis=0, return_index=True)
    kept = np.flatnonzero(inside)[np.sort(once)]
    return _Keypoints(pixels[kept], descriptors[kept])


def _free(pixels: FloatArray, taken: Sequence[FloatArray]) -> np.ndarray:
    """Which keypoints are no feature that is followed already."""
    if not len(pixels) or not taken:
        return np.ones(len(pixels), dtype=bool)
    apart = np.linalg.norm(pixels[:, None] - np.array(taken)[None], axis=2)
    return np.asarray((apart > SAME_PX).all(axis=1))


def _pair(
    views: Sequence[View],
    models: Sequence[CameraModel],
    keypoints: Sequence[_Keypoints],
    first: int,
    second: int,
    free: np.ndarray,
) -> list[tuple[int, FloatArray, FloatArray]]:
    """Features of one view in another: keypoint, pixel (2,) there, its covariance (2, 2)."""
    one, other = keypoints[first], keypoints[second]
    if not len(one.pixels_px) or not len(other.pixels_px):
        return []
    line, points = _lines(models[first], one.pixels_px, models[second])
    candidates: list[tuple[float, int, int, int]] = []
    for keypoint in np.flatnonzero(free & np.isfinite(line).any(axis=(1, 2))).tolist():
        at = line[keypoint]
        apart = np.linalg.norm(other.pixels_px[:, None] - at[None], axis=2)
        apart[~np.isfinite(apart)] = np.inf
        near = np.flatnonzero(apart.min(axis=1) < GATE_PX)
        if not len(near):
            continue
        distance = np.linalg.norm(other.descriptors[near] - one.descriptors[keypoint], axis=1)
        order = np.argsort(distance)
        best = int(near[order[0]])
        rival = next(
            (d for i, d in zip(near[order[1:]], distance[order[1:]], strict=True)
             if np.linalg.norm(other.pixels_px[i] - other.pixels_px[best]) > SAME_PX),
            np.inf,
        )  # fmt: skip
        if distance[order[0]] < RATIO * rival:
            candidates.append((float(distance[order[0]]), keypoint, best, int(apart[best].argmin())))
    matched: list[tuple[int, FloatArray, FloatArray]] = []
    used: set[int] = set()
    for _, keypoint, best, sample in sorted(candidates):
        if best in used or len(matched) >= MOST_A_PAIR:
            continue
        used.add(best)
        result = _matched(
            views,
            models,
            first,
            second,
            one.pixels_px[keypoint],
            points[keypoint, sample],
            other.pixels_px[best],
        )
        if result is not None:
            matched.append((keypoint, *result))
    return matched


def _lines(camera: CameraModel, pixels: FloatArray, other: CameraModel) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, s, 2) of the epipolar lines in the other camera, nan outside, and points (n, s, 3)."""
    inverse = np.linspace(1.0 / FARTHEST_M, 1.0 / NEAREST_M, 40)
    rays = camera.ray(pixels)
    points = rays.origins_m[:, None] + rays.directions[:, None] / inverse[None, :, None]
    seen, valid = other.project(points.reshape(-1, 3))
    size = np.array(other.size_px)
    with np.errstate(invalid="ignore"):
        inside = valid & ((seen >= -GATE_PX) & (seen <= size + GATE_PX)).all(axis=1)
    seen[~inside] = np.nan
    return seen.reshape(*points.shape[:2], 2), points


def _matched(
    views: Sequence[View],
    models: Sequence[CameraModel],
    first: int,
    second: int,
    pixel: FloatArray,
    point_m: FloatArray,
    start_px: FloatArray,
) -> tuple[FloatArray, FloatArray] | None:
    """The patch's place in the second view, if a patch on the ground or across the ray is there for sure.

    The second camera is turned so that the rig foresees the patch where SIFT has it.
    """
    camera = _turned_to(models[second], point_m, start_px)
    best = None
    for normal in (UP, models[first].C - point_m):
        try:
            match = match_patch(
                views[first].image,
                models[first],
                pixel,
                Plane(point_m, normal / np.linalg.norm(normal)),
                views[second].image,
                camera,
                WINDOW_PX,
                MatchSettings(),
            )
        except CalibError:
            continue
        if match.verdict == "good" and (best is None or match.correlation > best.correlation):
            best = match
    if best is None:
        return None
    covariance = np.asarray(best.covariance_px2) + FLOOR_SIGMA_PX**2 * np.eye(2)
    return np.asarray(best.pixel_px), covariance


def _turned_to(camera: CameraModel, point_m: FloatArray, pixel: FloatArray) -> CameraModel:
    """The camera turned about C by the little that brings a point onto a pixel."""
    from scipy.spatial.transform import Rotation

    from calib.rigid import Rigid

    wanted = camera.ray(pixel).directions
    has = point_m - camera.C
    axis = np.cross(wanted, has / np.linalg.norm(has))
    turn = Rotation.from_rotvec(axis).as_matrix()
    return camera.moved(Rigid(turn, camera.C - turn @ camera.C))
