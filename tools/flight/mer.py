"""Opportunity Navcam frames: the mast fitted to labels, features carried from one picture to the next.

Frames come through the ``replay`` driver, as they would from a live head and camera.

The rule by which features count: at most 400 Shi-Tomasi corners of the first picture (quality 0.02 of
the best, 25 px apart, 15 px blocks); the corner must lie in the second picture, 25 px from its border,
for some range from 2 m on; of windows of +-12 px, every 8 px along the epipolar line, with the patch
laid on level ground or across the ray, the best match counts if `calib.matching.patch` calls it good
(texture, correlation, one peak, certainty; its default thresholds) and no other good match more than 5 px
away comes near it. The windows are free in both directions, so nothing pulls a match to the line and nothing
sorts out large residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calib.errors import NoStereoPoint
from calib.geometry.cahvor import CameraModel
from calib.geometry.pointing import Solution, solve
from calib.geometry.rig import Rig, RigCamera
from calib.geometry.rigid import FloatArray, Rigid
from calib.geometry.stereo import triangulate
from calib.matching.partner import find_partner
from calib.matching.patch import MatchSettings, match_patch, rivalled
from calib.matching.warp import Plane, PosedImage, grey
from drivers.clock import ManualClock
from drivers.recordings.pds3 import PdsProduct, read_product
from drivers.recordings.replay import Replay, open_replay
from tools.command import rms
from tools.flight.poses import PoseFit, fit_poses

PRODUCTS = "1N4910*.IMG"
CAMERA = "navcam_left"

CORNERS, QUALITY, APART_PX, BLOCK_PX = 400, 0.02, 25, 15
MARGIN_PX = 25
NEAREST_M, FARTHEST_M = 2.0, 1e4
WINDOW_PX, WINDOW_EVERY_PX = 12.0, 8.0
UP = np.array([0.0, 0.0, -1.0])
NEIGHBOURS = 8
"""Matched features around one that tell its range when its own match may not."""


@dataclass(frozen=True, eq=False)
class FlightView(PosedImage):
    """One replayed frame: grey picture, measured angles, and the camera there in the rover frame."""

    pan_rad: float
    tilt_rad: float


@dataclass(frozen=True, eq=False)
class CarriedFeatures:
    """A feature of one view found in another.

    ``across_px`` is its signed distance from the epipolar line; ``position_m`` the point that both views see.
    """

    pixel_px: FloatArray
    found_px: FloatArray
    across_px: float
    position_m: FloatArray


@dataclass(frozen=True, eq=False)
class Rehearsal:
    """A pointing at a feature of one view, aimed at the pixel of another view where it should be seen.

    The range comes from neighbouring features, never from the feature's own match. ``solution`` are the
    angles that put it on ``aim_px``, ``off_rad`` how far they are from the recorded ones.
    """

    carried: CarriedFeatures
    aim_px: FloatArray
    solution: Solution
    off_rad: float

    @property
    def residual_px(self) -> FloatArray:
        """(2,) where the feature is, minus where it was aimed to be."""
        return self.carried.found_px - self.aim_px


def labels(folder: Path) -> list[PdsProduct]:
    """Return the five frames' labels, in the order of the recording."""
    return [read_product(path, with_image=False) for path in sorted(folder.glob(PRODUCTS))]


def fit(products: Sequence[PdsProduct], parameters: int = 6) -> PoseFit:
    """Fit the paper's mast (or with axis offset and twist) to the labels' models at their measured angles."""
    return fit_poses(
        [product.camera_model for product in products if product.camera_model is not None],
        [product.azimuth_measured_rad or 0.0 for product in products],
        [product.elevation_measured_rad or 0.0 for product in products],
        parameters=8 if parameters == 8 else 6,
    )


def rig(fitted: PoseFit, products: Sequence[PdsProduct]) -> Rig:
    """Return what the mast file of the replayed rover holds."""
    worst = max(float(np.linalg.norm(found.shift_px, axis=-1).max()) for found in fitted.residuals)
    return Rig(
        name="opportunity",
        mast=fitted.mast,
        cameras={CAMERA: RigCamera("head", fitted.camera_in_head)},
        fit={"camera_models": len(products), "worst_shift_px": worst},
        provenance={"products": [product.product_id for product in products], "credit": "NASA/JPL-Caltech"},
    )


def replay(folder: Path, clock: ManualClock) -> Replay:
    """Open the frames through the replay driver."""
    return open_replay({"products": PRODUCTS, "camera": CAMERA}, folder, clock)


def views(recording: Replay, clock: ManualClock, rover: Rig) -> list[FlightView]:
    """Move the replayed head to every pointing in turn and take a picture there."""
    found = []
    for pointing in recording.pointings:
        recording.pan_tilt.move(pointing.pan_rad, pointing.tilt_rad)
        frame = recording.cameras[CAMERA].next_frame(clock.now_s(), 1.0)
        reading = recording.pan_tilt.read()
        camera = rover.camera_in_rover(CAMERA, reading.pan_rad, reading.tilt_rad)
        found.append(FlightView(grey(frame.image), camera, reading.pan_rad, reading.tilt_rad))
    return found


def features(first: FlightView, second: FlightView) -> FloatArray:
    """Return the corners (n, 2) of the first view that the second may see."""
    corners = cv2.goodFeaturesToTrack(first.image, CORNERS, QUALITY, APART_PX, blockSize=BLOCK_PX)[:, 0]
    size = np.array(second.camera.size_px)
    seen = np.zeros(len(corners), dtype=bool)
    for index, corner in enumerate(corners):
        _, pixels = epipolar_line(first.camera, corner, second.camera)
        seen[index] = bool(((pixels >= MARGIN_PX) & (pixels <= size - 1 - MARGIN_PX)).all(axis=1).any())
    return np.asarray(corners[seen], dtype=np.float64)


def epipolar_line(
    camera: CameraModel, pixel_px: FloatArray, other: CameraModel
) -> tuple[FloatArray, FloatArray]:
    """Return inverse ranges (m,) and pixels (m, 2) of the epipolar line, where the other camera has it."""
    ray = camera.ray(np.asarray(pixel_px, dtype=np.float64))
    inverse = np.linspace(1.0 / FARTHEST_M, 1.0 / NEAREST_M, 400)
    pixels, valid = other.project(ray.origins_m + ray.directions / inverse[:, None])
    return inverse[valid], pixels[valid]


def carry(first: FlightView, pixel_px: FloatArray, second: FlightView) -> CarriedFeatures | None:
    """Find a feature of the first view in the second, by the rule above; None if no match counts."""
    settings = MatchSettings()
    ray = first.camera.ray(pixel_px)
    inverse, pixels = epipolar_line(first.camera, pixel_px, second.camera)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pixels, axis=0), axis=1))])
    steps = np.interp(np.arange(0.0, length[-1] + WINDOW_EVERY_PX, WINDOW_EVERY_PX), length, inverse)
    good = []
    for inverse_range in steps:
        point = ray.origins_m + ray.directions / inverse_range
        for normal in (UP, -ray.directions):
            found = match_patch(first, pixel_px, Plane(point, normal), second, WINDOW_PX, settings)
            if found.verdict == "good":
                good.append(found)
    if not good:
        return None
    best = max(good, key=lambda one: one.correlation)
    elsewhere = [
        one.correlation for one in good if np.linalg.norm(one.pixel_px - best.pixel_px) > settings.apart_px
    ]
    if elsewhere and rivalled(best.correlation, max(elsewhere), settings):
        return None
    try:
        position = triangulate(first.camera, second.camera, pixel_px, best.pixel_px).position_m
    except NoStereoPoint:  # a match so near the vanishing point that the rays diverge: a false one
        return None
    across = across_px(first.camera, pixel_px, second.camera, best.pixel_px)
    return CarriedFeatures(pixel_px, best.pixel_px, across, position)


def across_px(first: CameraModel, pixel_px: FloatArray, second: CameraModel, found_px: FloatArray) -> float:
    """Return how far a pixel of the second camera is from the epipolar line of one of the first, signed."""
    _, pixels = epipolar_line(first, pixel_px, second)
    at = int(np.clip(np.argmin(np.linalg.norm(pixels - found_px, axis=1)), 1, len(pixels) - 2))
    along = pixels[at + 1] - pixels[at - 1]
    x, y = found_px - pixels[at]
    return float((along[0] * y - along[1] * x) / np.linalg.norm(along))


def carried_features(first: FlightView, second: FlightView) -> tuple[int, list[CarriedFeatures]]:
    """Return how many features the second view may see, and those whose match counts."""
    corners = features(first, second)
    found = [carry(first, corner, second) for corner in corners]
    return len(corners), [one for one in found if one is not None]


def pair_result(
    first: FlightView, second: FlightView, seen: int, carried: Sequence[CarriedFeatures]
) -> dict[str, float]:
    """Return a pair's row: residuals across the epipolar line, pixels, and ranges, metres.

    ``turned_*``: after a turn of the second camera (3 parameters), which its pointing error may be.
    ``on_line_*``: the service's own search, bound to the line, for comparison.
    """
    across = np.array([one.across_px for one in carried])
    _, left = turned(first, second, carried)
    on_line = [find_partner(first, corner, second, NEAREST_M) for corner in features(first, second)]
    on_line_px = [one.across_px for one in on_line if one.match.verdict == "good"]
    ranges = [float(np.linalg.norm(one.position_m - first.camera.C)) for one in carried]
    return {
        "seen": seen,
        "matched": len(carried),
        "nearest_m": min(ranges),
        "farthest_m": max(ranges),
        "median_px": np.median(np.abs(across)),
        "rms_px": rms(across),
        "worst_px": np.abs(across).max(),
        "mean_px": across.mean(),
        "turned_median_px": np.median(np.abs(left)),
        "turned_rms_px": rms(left),
        "on_line_matched": len(on_line_px),
        "on_line_median_px": np.median(np.abs(on_line_px)),
    }


def turned_about_itself(camera: CameraModel, turn_rad: FloatArray) -> CameraModel:
    """Return the camera turned about its own centre by a rotation vector (3,) of its frame."""
    rotation = Rotation.from_rotvec(turn_rad).as_matrix()
    return camera.moved(Rigid(rotation, camera.C - rotation @ camera.C))


def turned(
    first: FlightView, second: FlightView, carried: Sequence[CarriedFeatures]
) -> tuple[FloatArray, FloatArray]:
    """Return the turn (3,) of the second camera that leaves the least across the lines, and the rest."""

    def across(turn_rad: FloatArray) -> FloatArray:
        turned = turned_about_itself(second.camera, turn_rad)
        return np.array([across_px(first.camera, one.pixel_px, turned, one.found_px) for one in carried])

    best = least_squares(across, np.zeros(3), x_scale=1e-3, diff_step=np.full(3, 1e-2))
    return best.x, best.fun


def rehearse(
    first: FlightView, second: FlightView, carried: Sequence[CarriedFeatures], index: int, rover: Rig
) -> Rehearsal:
    """Point at a feature as the service would: range, target, aim, angles; then see where it is.

    The range is that of the plane through the nearest other features.
    """
    this = carried[index]
    others = [one for at, one in enumerate(carried) if at != index]
    others.sort(key=lambda one: float(np.linalg.norm(one.pixel_px - this.pixel_px)))
    around = np.array([one.position_m for one in others[:NEIGHBOURS]])
    _, _, axes = np.linalg.svd(around - around.mean(axis=0))
    ray = first.camera.ray(this.pixel_px)
    reach = ((around.mean(axis=0) - ray.origins_m) @ axes[2]) / (ray.directions @ axes[2])
    target = ray.origins_m + reach * ray.directions
    aim, _ = second.camera.project(target)
    head_camera = rover.cameras[CAMERA].model
    best = solve(
        rover.mast, head_camera, target, aim, from_pan_rad=first.pan_rad, from_tilt_rad=first.tilt_rad
    )[0]
    off = max(abs(best.pan_rad - second.pan_rad), abs(best.tilt_rad - second.tilt_rad))
    return Rehearsal(this, aim, best, off)
