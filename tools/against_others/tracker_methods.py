"""The trackers that `trackers` puts side by side, each fed one stop of a sequence at a time.

All track both eyes of a stereo pair. The others know nothing of stereo and track the left and the right
pixel each for itself, from the true pixels of the first stop. Their two kinds of rows:

- plain: from where the target was found last, in windows of +-100 px (the target never moves farther);
- assisted: each starts from the pixel that odometry predicts from the *true* place before, and the template
  is scaled by the true ratio of ranges. That is more than any tracker could be told.

Thresholds at which they call a target lost are the usual ones, stated at the constants.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import cv2
import numpy as np

from calib.errors import CalibError
from calib.geometry.rigid import FloatArray
from calib.matching.handoff import Eye
from calib.matching.look import seen_by
from calib.matching.track import moved_track, start_track
from calib.matching.warp import grey
from tools.against_others.tracker_sequences import STEPS, Sequence

HALF_PX = 20
"""Half side of the others' patch: 41 px, as the bench that this repeats has it."""
REACH_PX = 100
LEAST_SCORE = 0.6
"""Correlation below which template matching says lost."""
LK_PX, LK_LEVELS, LK_CROP_PX = 21, 4, 200
BACK_PX = 1.0
"""Forward and backward of the optical flow may differ by this much."""
GRID_PX = np.stack(np.meshgrid(*[np.linspace(-HALF_PX, HALF_PX, 7)] * 2), axis=-1).reshape(-1, 2)
LEAST_INLIERS = 10

Tracked = tuple[FloatArray, FloatArray]
"""Found pixels (20, 2, 2), not-a-number where it said lost, and milliseconds (20,) of a step, both eyes."""


def ours(sequence: Sequence) -> Tracked:
    """`calib.matching.track`, as the approach uses it: from uint8 pictures and odometry to both pixels."""
    found, times = np.full((STEPS, 2, 2), np.nan), np.full(STEPS, np.nan)
    try:
        track = start_track(*_eyes(sequence, 0).values(), sequence.truth_px[0, 0])
    except CalibError:
        return found, times
    for step in range(STEPS):
        start = time.thread_time()
        track = moved_track(track, sequence.motions[step], sequence.covariances[step])
        look = seen_by(track, _eyes(sequence, step + 1))
        track = look.track
        times[step] = 1e3 * (time.thread_time() - start)
        if track.state == "tracked":
            for index, name in enumerate(("left", "right")):
                one = look.found.get(name)
                if one is not None and one.verdict == "good":
                    found[step, index] = one.pixel_px
    return found, times


def _eyes(sequence: Sequence, stop: int) -> dict[str, Eye]:
    pairs = zip(("left", "right"), sequence.images[stop], sequence.cameras[stop], strict=True)
    return {name: Eye(grey(image), camera) for name, image, camera in pairs}


Follow = Callable[[np.ndarray, FloatArray, np.ndarray, FloatArray, float], FloatArray | None]
"""(image before, pixel there, image now, where to start there, scale) -> the pixel, or None for lost."""


def eye_by_eye(follow: Follow, sequence: Sequence, assisted: bool) -> Tracked:
    """Follow both pixels with a method that knows one picture at a time.

    The picture before is the last one in which the target was found.
    """
    found, times = np.full((STEPS, 2, 2), np.nan), np.full(STEPS, np.nan)
    last = [(0, sequence.truth_px[0, index]) for index in range(2)]
    for step in range(STEPS):
        start = time.thread_time()
        for index in range(2):
            stop, pixel = last[index]
            begin = sequence.predicted_px[step, index] if assisted else pixel
            scale = float(sequence.ranges_m[stop] / sequence.ranges_m[step + 1]) if assisted else 1.0
            before, now = sequence.images[stop, index], sequence.images[step + 1, index]
            new = follow(before, pixel, now, begin, scale)
            if new is not None:
                found[step, index] = new
                last[index] = (step + 1, new)
        times[step] = 1e3 * (time.thread_time() - start)
    return found, times


def match_template(
    before: np.ndarray, pixel: FloatArray, now: np.ndarray, begin: FloatArray, scale: float
) -> FloatArray | None:
    """Normalised correlation of a patch, scaled about its middle, with a parabola through the peak."""
    half = HALF_PX / scale
    size = 2 * HALF_PX + 1
    corner = pixel - half
    affine = np.array([[1 / scale, 0.0, corner[0]], [0.0, 1 / scale, corner[1]]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    template = cv2.warpAffine(before, affine, (size, size), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    low = np.maximum(np.rint(begin).astype(int) - HALF_PX - REACH_PX, 0)
    high = np.minimum(np.rint(begin).astype(int) + HALF_PX + REACH_PX + 1, now.shape[::-1])
    if (high - low < size).any():
        return None
    scores = cv2.matchTemplate(now[low[1] : high[1], low[0] : high[0]], template, cv2.TM_CCOEFF_NORMED)
    _, best, _, (x, y) = cv2.minMaxLoc(scores)
    if best < LEAST_SCORE:
        return None
    return np.asarray(low + HALF_PX + [x + _vertex(scores[y], x), y + _vertex(scores[:, x], y)])


def _vertex(scores: np.ndarray, at: int) -> float:
    """Where the parabola through a peak and its neighbours has its top, from the peak."""
    if not 0 < at < len(scores) - 1:
        return 0.0
    left, middle, right = (float(value) for value in scores[at - 1 : at + 2])
    curve = left - 2 * middle + right
    return 0.5 * (left - right) / curve if curve < 0 else 0.0


def lucas_kanade(
    before: np.ndarray, pixel: FloatArray, now: np.ndarray, begin: FloatArray, scale: float
) -> FloatArray | None:
    """One point by pyramids, forth and back."""
    flow = _flow(before, pixel[None], now, begin[None])
    return flow[0] if np.isfinite(flow).all() else None


def lucas_kanade_grid(
    before: np.ndarray, pixel: FloatArray, now: np.ndarray, begin: FloatArray, scale: float
) -> FloatArray | None:
    """7 x 7 points around the target, forth and back, and RANSAC's affine map through them."""
    points = pixel + GRID_PX
    flow = _flow(before, points, now, begin + scale * GRID_PX)
    good = np.isfinite(flow).all(axis=1)
    if good.sum() < LEAST_INLIERS:
        return None
    affine, inliers = cv2.estimateAffine2D(points[good], flow[good], ransacReprojThreshold=1.0)
    if affine is None or int(inliers.sum()) < LEAST_INLIERS:
        return None
    return np.asarray(affine @ [*pixel, 1.0])


def _flow(before: np.ndarray, points: FloatArray, now: np.ndarray, begin: FloatArray) -> FloatArray:
    """Optical flow of points (n, 2) in crops around them; not-a-number where forth and back disagree."""
    old, old_low = _crop(before, points.mean(axis=0))
    new, new_low = _crop(now, begin.mean(axis=0))
    window = {"winSize": (LK_PX, LK_PX), "maxLevel": LK_LEVELS}
    there = (points - old_low).astype(np.float32).reshape(-1, 1, 2)
    guess = (begin - new_low).astype(np.float32).reshape(-1, 1, 2)
    forth, ok, _ = cv2.calcOpticalFlowPyrLK(
        old, new, there, guess.copy(), **window, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(
        new, old, forth, there + (forth - guess), **window, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    apart = np.linalg.norm((back - there).reshape(-1, 2), axis=1)
    good = (ok.ravel() == 1) & (ok_back.ravel() == 1) & (apart <= BACK_PX)
    return np.where(good[:, None], forth.reshape(-1, 2) + new_low, np.nan)


def _crop(image: np.ndarray, around: FloatArray) -> tuple[np.ndarray, np.ndarray]:
    """A crop of fixed size about a pixel, whole inside the picture, and its corner."""
    size = 2 * LK_CROP_PX + 1
    low = np.clip(np.rint(around).astype(int) - LK_CROP_PX, 0, np.array(image.shape[::-1]) - size)
    return image[low[1] : low[1] + size, low[0] : low[0] + size], low


METHODS: dict[str, Callable[[Sequence], Tracked]] = {
    "ours": ours,
    "matchTemplate": lambda s: eye_by_eye(match_template, s, False),
    "matchTemplate, assisted": lambda s: eye_by_eye(match_template, s, True),
    "Lucas-Kanade": lambda s: eye_by_eye(lucas_kanade, s, False),
    "Lucas-Kanade, assisted": lambda s: eye_by_eye(lucas_kanade, s, True),
    "Lucas-Kanade grid": lambda s: eye_by_eye(lucas_kanade_grid, s, False),
    "Lucas-Kanade grid, assisted": lambda s: eye_by_eye(lucas_kanade_grid, s, True),
}
