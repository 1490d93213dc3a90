"""Features of one picture found again in others: SIFT says which, least-squares matching says where.

A feature is a patch of the first picture that shows it (its anchor); everywhere else it is measured. SIFT's
own places scatter by some tenths of a pixel, so they only start the match (`calib.matching.patch`),
on the patch as the rig foresees it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from calib.calibrate.scene.terms import FARTHEST_M, NEAREST_M, SceneView, overlapping
from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, Rigid
from calib.matching.patch import match_patch
from calib.matching.verdict import MatchSettings
from calib.matching.warp import Grey, Plane, facing_plane

MOST_KEYPOINTS = 3000
GATE_PX = 20.0
"""How far from its epipolar line a feature is looked for: what a bumped camera may be off."""

WINDOW_PX = 4.0
"""How far from SIFT's place the patch is matched."""

RATIO = 0.85
MARGIN_PX = 22.0
MOST_A_PAIR, MOST_A_CELL, CELL_PX = 25, 3, 100
"""Features of two pictures, and of a square of one: of 0.1 px, so many tell where one camera stands against
the other ten times better than joints repeat."""

MOST_PARTNERS = 8
"""Later pictures that one is held against, those that overlap most: they are tied together through these."""

ALIKE = 0.95
"""A patch on the ground that correlates so needs no other try."""

SAMPLES = 16
"""Places along a line: not more than half a gate apart."""
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


def find_features(rig: Rig, views: Sequence[SceneView]) -> list[Feature]:
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
    looks = [_Look(view, model, found) for view, model, found in zip(views, models, keypoints, strict=True)]
    together: list[list[int]] = [[] for _ in views]
    parts = overlapping(models)
    for first, second in sorted(parts, key=lambda pair: -parts[pair]):
        if len(together[first]) < MOST_PARTNERS:
            together[first].append(second)
    features: list[Feature] = []
    for first, look in enumerate(looks):
        found: dict[int, list[tuple[int, FloatArray, FloatArray]]] = {}
        free = look.free
        for second in together[first]:
            for keypoint, pixel, covariance in _pair(look, looks[second], free, set(found)):
                found.setdefault(keypoint, []).append((second, pixel, covariance))
                looks[second].followed.append(pixel)
        for keypoint, seen in found.items():
            features.append(
                Feature(
                    (first, *(view for view, _, _ in seen)),
                    np.array([keypoints[first].pixels_px[keypoint], *(pixel for _, pixel, _ in seen)]),
                    np.array([ANCHOR_SIGMA_PX**2 * np.eye(2), *(covariance for _, _, covariance in seen)]),
                )
            )
    return features


@dataclass(eq=False)
class _Look:
    """A picture's camera and keypoints, and where features are followed in it already."""

    view: SceneView
    model: CameraModel
    keypoints: _Keypoints
    followed: list[FloatArray] = field(default_factory=list)

    @cached_property
    def tree(self) -> cKDTree:
        """The keypoints, to be asked which are near."""
        return cKDTree(self.keypoints.pixels_px)

    @property
    def free(self) -> np.ndarray:
        """Which keypoints are no feature that is followed already."""
        pixels = self.keypoints.pixels_px
        if not len(pixels) or not self.followed:
            return np.ones(len(pixels), dtype=bool)
        return np.asarray(cKDTree(np.array(self.followed)).query(pixels)[0] > SAME_PX)


def _keypoints(view: SceneView) -> _Keypoints:
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


def _pair(
    first: _Look, second: _Look, free: np.ndarray, known: set[int]
) -> list[tuple[int, FloatArray, FloatArray]]:
    """Features of one view in another: keypoint, pixel (2,) there, its covariance (2, 2).

    As many as tell where one camera is against the other, spread over what both see; those that are ``known``
    from other views first.
    """
    matched: list[tuple[int, FloatArray, FloatArray]] = []
    used: set[int] = set()
    cells: Counter[tuple[int, int]] = Counter()
    candidates = _candidates(first, second, free)
    for keypoint, best, point_m in sorted(candidates, key=lambda one: one[0] not in known):
        pixel = first.keypoints.pixels_px[keypoint]
        x, y = (pixel // CELL_PX).astype(int).tolist()
        if best in used or cells[x, y] >= MOST_A_CELL:
            continue
        used.add(best)
        result = _matched(first, second, pixel, point_m, second.keypoints.pixels_px[best])
        if result is not None:
            cells[x, y] += 1
            matched.append((keypoint, *result))
            if len(matched) == MOST_A_PAIR:
                break
    return matched


def _candidates(first: _Look, second: _Look, free: np.ndarray) -> list[tuple[int, int, FloatArray]]:
    """Keypoints alike along the lines, likest first: one's, the other's, and the point (3,) in space."""
    one, other = first.keypoints, second.keypoints
    mine = np.flatnonzero(free)
    if not len(mine) or not len(other.pixels_px):
        return []
    line, points = _lines(first.model, one.pixels_px[mine], second.model)
    seen = np.argwhere(np.isfinite(line).all(axis=2))
    near: list[list[int]] = list(
        second.tree.query_ball_point(line[seen[:, 0], seen[:, 1]], GATE_PX, return_sorted=False)  # type: ignore[arg-type]
    )
    counts = [len(these) for these in near]
    if not sum(counts):
        return []
    rows, samples = np.repeat(seen, counts, axis=0).T
    theirs = np.concatenate([np.array(these, dtype=np.intp) for these in near if these])
    pairs, at = np.unique(rows * len(other.pixels_px) + theirs, return_index=True)
    rows, theirs, samples = pairs // len(other.pixels_px), pairs % len(other.pixels_px), samples[at]
    distance = np.linalg.norm(other.descriptors[theirs] - one.descriptors[mine[rows]], axis=1)
    order = np.lexsort((distance, rows))
    rows, theirs, samples, distance = rows[order], theirs[order], samples[order], distance[order]
    _, best, row = np.unique(rows, return_index=True, return_inverse=True)
    apart = other.pixels_px[theirs] - other.pixels_px[theirs[best[row]]]
    rival = np.full(len(best), np.inf)
    np.minimum.at(rival, row, np.where((apart**2).sum(axis=1) > SAME_PX**2, distance, np.inf))
    alike = best[distance[best] < RATIO * rival]
    alike = alike[np.argsort(distance[alike], kind="stable")]
    return [(int(mine[rows[k]]), int(theirs[k]), points[rows[k], samples[k]]) for k in alike.tolist()]


def _lines(camera: CameraModel, pixels: FloatArray, other: CameraModel) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, s, 2) of the epipolar lines in the other camera, nan outside, and points (n, s, 3)."""
    inverse = np.linspace(1.0 / FARTHEST_M, 1.0 / NEAREST_M, SAMPLES)
    rays = camera.ray(pixels)
    points = rays.origins_m[:, None] + rays.directions[:, None] / inverse[None, :, None]
    seen, valid = other.project(points.reshape(-1, 3))
    size = np.array(other.size_px)
    with np.errstate(invalid="ignore"):
        inside = valid & ((seen >= -GATE_PX) & (seen <= size + GATE_PX)).all(axis=1)
    seen[~inside] = np.nan
    return seen.reshape(*points.shape[:2], 2), points


def _matched(
    first: _Look, second: _Look, pixel: FloatArray, point_m: FloatArray, start_px: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """The patch's place in the second view, if a patch on the ground or across the ray is there for sure.

    The second camera is turned so that the rig foresees the patch where SIFT has it.
    """
    camera = _turned_to(second.model, point_m, start_px)
    best = None
    for normal in (UP, first.model.C - point_m):
        try:
            match = match_patch(
                first.view.image,
                first.model,
                pixel,
                Plane(point_m, normal / np.linalg.norm(normal)),
                second.view.image,
                camera,
                WINDOW_PX,
                MatchSettings(),
            )
        except CalibError:
            continue
        if match.verdict == "good" and (best is None or match.correlation > best.correlation):
            best = match
            if best.correlation > ALIKE:
                break
    if best is None:
        return None
    covariance = np.asarray(best.covariance_px2) + FLOOR_SIGMA_PX**2 * np.eye(2)
    return np.asarray(best.pixel_px), covariance


def _turned_to(camera: CameraModel, point_m: FloatArray, pixel: FloatArray) -> CameraModel:
    """The camera turned about C by the little that brings a point onto a pixel."""
    wanted = camera.ray(pixel).directions
    has = point_m - camera.C
    axis = np.cross(wanted, has / np.linalg.norm(has))
    turn = Rotation.from_rotvec(axis).as_matrix()
    return camera.moved(Rigid(turn, camera.C - turn @ camera.C))


MOST_FEATURES = 60
QUALITY, APART_PX, EDGE_PX = 0.02, 40, 26
SEARCH_PX = 30.0
"""How far a feature is looked for: a bump or slip of some 20 mrad in a Navcam."""

FLOOR_PX = 0.03
_RANGE_M = 5.0
_SETTINGS = MatchSettings(half_px=14, roughness=0.0)


def seen_again(camera: CameraModel, then: Grey, now: Grey) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return features of a picture (n, 2), how far they have moved (n, 2) and its sigma (n,), all in pixels.

    Parameters
    ----------
    camera
        That took both, in any frame.
    then, now
        (h, w) grey.
    """
    image = np.clip(np.rint(then), 0, 255).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(image, 4 * MOST_FEATURES, QUALITY, APART_PX, blockSize=15)
    pixels: list[FloatArray] = []
    moved: list[FloatArray] = []
    sigmas: list[float] = []
    width, height = camera.size_px
    for corner in [] if corners is None else np.rint(corners[:, 0].astype(np.float64)):
        if len(pixels) == MOST_FEATURES:
            break
        if not (EDGE_PX <= corner[0] < width - EDGE_PX and EDGE_PX <= corner[1] < height - EDGE_PX):
            continue
        try:
            plane = facing_plane(camera, corner, _RANGE_M)
            match = match_patch(then, camera, corner, plane, now, camera, SEARCH_PX, _SETTINGS)
        except CalibError:
            continue
        if match.verdict == "good":
            pixels.append(corner)
            moved.append(match.pixel_px - corner)
            sigmas.append(float(np.hypot(np.sqrt(np.trace(match.covariance_px2) / 2.0), FLOOR_PX)))
    count = len(pixels)
    return np.reshape(pixels, (count, 2)), np.reshape(moved, (count, 2)), np.array(sigmas)
