"""Finds a change since reference images were taken: in their differences, tested, with its size.

Each view (a camera at a rest of the head) is taken again; its features have moved by little. A robust fit
turns them into four numbers: shift x and y of the picture's middle, a turn about it, a change of scale.
Things that moved by themselves (rocks, shadows' edges) are left out there. The numbers of all views are then
tested against what one change would do to them: a camera turned or refocused, a joint slipped, the rover
turned under the mast. The likeliest counts; which one it was is not reported. Light and
weather spoil a view as a whole, so each view has an error of its own beside that of its features, and each
rest one of both joints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import cv2
import numpy as np

from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import JOINT_NAMES, pixel_rates
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, rigid_rates
from calib.geometry.significance import MEDIAN_OF_TWO, chance, sigmas
from calib.matching.patch import MatchSettings, match_patch
from calib.matching.warp import Grey, PosedImage, facing_plane

ALARM_SIGMAS = 6.0
"""A change is reported from here on, if two checks one after the other find it."""

JOINT_SIGMA_RAD = 2e-4
"""What a rest of the head is off by chance, each time."""

VIEW_SIGMA = np.array([0.1, 0.1, 1e-4, 1e-4])
"""The motion of a whole view by light, weather and temperature: px, px, rad, part of the scale."""

LEAST_FEATURES = 8
LEAST_PART, MOST_SPREAD_PX = 0.4, 1.5
"""Fewer of a view's features that move as one, or less alike, and it says nothing: fog, another scene."""

NEAREST_M, FARTHEST_M = 1.0, 30.0
"""The scene is assumed to lie on level ground under the rover, within these ranges."""

MOST_FEATURES = 60
QUALITY, APART_PX, EDGE_PX = 0.02, 40, 26
SEARCH_PX = 30.0
"""How far a feature is searched for: a bump or slip of some 20 mrad in a Navcam."""

FLOOR_PX = 0.03
_RANGE_M = 5.0
_SETTINGS = MatchSettings(half_px=14, roughness=0.0)

_TUKEY = 4.0


@dataclass(frozen=True, eq=False)
class ViewShift:
    """The features of one view, a camera's at one of the reference rests (true angles): their pixels (n, 2)
    in the reference picture, how far they have moved since (n, 2), and the sigma of its coordinates (n,)."""

    camera: str
    pose: int
    pan_rad: float
    tilt_rad: float
    pixels_px: FloatArray
    moved_px: FloatArray
    sigma_px: FloatArray


class ViewChange(NamedTuple):
    """Shift x, y (px), turn (rad), scale; their covariance (4, 4); which part of the features agrees."""

    numbers: FloatArray
    covariance: FloatArray
    agreeing: float


@dataclass(frozen=True, eq=False)
class SceneDrift:
    """The result of taking the views of a reference again.

    ``views`` could be compared, ``silent`` not. ``sigmas``: how unlikely the differences are without a
    change; ``moved_px``: how far it moves a pixel, at most. ``missing`` says why a camera,
    or one at a rest, gave no image.
    """

    views: int
    silent: tuple[str, ...] = ()
    sigmas: float = 0.0
    moved_px: float = 0.0
    missing: Mapping[str, str] = field(default_factory=dict)

    @property
    def changed(self) -> bool:
        """Whether something has changed, from ``ALARM_SIGMAS`` on."""
        return self.sigmas >= ALARM_SIGMAS

    @property
    def sentence(self) -> str:
        """The change by its size: ``the images moved by up to 2.1 px, 9 sigma``; empty without one."""
        if not self.changed:
            return ""
        return f"the images moved by up to {self.moved_px:.2f} px, {self.sigmas:.0f} sigma"


def view_change(shift: ViewShift, size_px: tuple[int, int]) -> ViewChange | None:
    """Return how a view as a whole changed, None if too few of its features moved as one."""
    count = len(shift.pixels_px)
    if count < LEAST_FEATURES:
        return None
    rates = _rates(shift.pixels_px, size_px)
    numbers = np.concatenate([np.median(shift.moved_px, axis=0), [0.0, 0.0]])
    wide = 1.4826 * np.median(np.abs(shift.moved_px - numbers[:2]))
    spread = max(float(wide), float(np.median(shift.sigma_px)))
    sigma = np.hypot(shift.sigma_px, 0.02)
    normal = np.eye(4)
    weights = np.ones(count)
    for _ in range(12):
        off = np.linalg.norm(shift.moved_px - rates @ numbers, axis=1)
        cut = _TUKEY * np.hypot(sigma, spread)
        weights = np.where(off < cut, (1.0 - (off / cut) ** 2) ** 2, 0.0)
        if np.count_nonzero(weights) < LEAST_FEATURES:
            return None
        weighted = rates * (weights / sigma**2)[:, None, None]
        normal = np.einsum("nij,nik->jk", weighted, rates)
        numbers = np.linalg.solve(normal, np.einsum("nij,ni->j", weighted, shift.moved_px))
        left = np.linalg.norm(shift.moved_px - rates @ numbers, axis=1)[weights > 0.1]
        spread = float(np.median(left)) if len(left) else spread
    agreeing = float(np.mean(weights > 0.1))
    if agreeing < LEAST_PART or spread > MOST_SPREAD_PX:
        return None
    scatter = max(1.0, (spread / float(np.median(sigma))) ** 2 / MEDIAN_OF_TWO)
    covariance = np.asarray(scatter * np.linalg.inv(normal) + np.diag(VIEW_SIGMA**2), dtype=np.float64)
    return ViewChange(numbers, covariance, agreeing)


def find_drift(rig: Rig, shifts: Sequence[ViewShift], joint_sigma_rad: float = JOINT_SIGMA_RAD) -> SceneDrift:
    """Return what differences between reference pictures and new ones say of a rig.

    ``shifts`` are of each camera at each rest once; ``joint_sigma_rad`` is what a rest of the head is off by
    chance, then and now, one sigma.
    """
    found = [(shift, view_change(shift, rig.cameras[shift.camera].model.size_px)) for shift in shifts]
    compared = [(shift, change) for shift, change in found if change is not None]
    silent = tuple(f"{shift.camera} at rest {shift.pose}" for shift, change in found if change is None)
    drift = SceneDrift(len(compared), silent)
    if not compared:
        return drift
    y = np.concatenate([change.numbers for _, change in compared])
    columns = _columns(rig, [shift for shift, _ in compared])
    inverse = np.linalg.inv(_noise(compared, columns, joint_sigma_rad))
    sizes_px = [rig.cameras[shift.camera].model.size_px for shift, _ in compared]
    corner_px = np.array([np.hypot(width, height) / 2.0 for width, height in sizes_px])
    best = -np.inf
    for rates in columns.values():
        normal = rates.T @ inverse @ rates
        if np.linalg.cond(normal) > 1e12:
            continue
        values = np.linalg.solve(normal, rates.T @ inverse @ y)
        gain, freedom = float(values @ normal @ values), max(len(y) - len(values), 1)
        scale = max(1.0, (float(y @ inverse @ y) - gain) / freedom)
        # What a number more must explain: Schwarz's criterion.
        worth = gain / scale - float(np.log(len(y))) * len(values)
        if worth > best:
            best = worth
            x, y_px, turn, scaled = (rates @ values).reshape(-1, 4).T
            moved_px = float((np.hypot(x, y_px) + corner_px * np.hypot(turn, scaled)).max())
            by_chance = sigmas(chance(gain, len(values), scale, freedom))
            drift = replace(drift, sigmas=by_chance, moved_px=moved_px)
    return drift


def _noise(
    compared: Sequence[tuple[ViewShift, ViewChange]], columns: dict[str, FloatArray], joint_sigma_rad: float
) -> FloatArray:
    """Covariance (4v, 4v): each view's own, and each rest's joint errors, of then and of now."""
    size = 4 * len(compared)
    covariance = np.zeros((size, size))
    for at, (_, change) in enumerate(compared):
        covariance[4 * at : 4 * at + 4, 4 * at : 4 * at + 4] = change.covariance
    poses = np.repeat([shift.pose for shift, _ in compared], 4)
    for pose in np.unique(poses):
        for joint in ("pan", "tilt"):
            mine = np.where(poses == pose, columns[joint][:, 0], 0.0)
            covariance += 2.0 * joint_sigma_rad**2 * np.outer(mine, mine)
    return covariance


def _columns(rig: Rig, shifts: Sequence[ViewShift]) -> dict[str, FloatArray]:
    """By change that is tested: how the views' numbers follow those that change (4v, k).

    A camera that is turned in the head or refocused changes all its views alike.
    """
    views = [_responses(rig, shift) for shift in shifts]
    found = {name: np.concatenate([view[name] for view in views]) for name in ("pan", "tilt", "rover")}
    for camera in dict.fromkeys(shift.camera for shift in shifts):
        mine = [float(shift.camera == camera) for shift in shifts]
        found[camera] = np.kron(np.array(mine)[:, None], np.eye(4))
    return found


def _responses(rig: Rig, shift: ViewShift) -> dict[str, FloatArray]:
    """How a view's four numbers, taken from its own features, follow joints and rover (4, k)."""
    rays = rig.camera_in_rover(shift.camera, shift.pan_rad, shift.tilt_rad).ray(shift.pixels_px)
    points = rays.origins_m + _ranges_m(rays.origins_m, rays.directions)[:, None] * rays.directions
    seen = pixel_rates(rig, JOINT_NAMES, shift.camera, shift.pan_rad, shift.tilt_rad, points)
    # The rover carries the camera: points move the other way before it.
    by_rover = -rigid_rates(seen.to_points, points, np.zeros(3))[..., :3]
    moved_px = {"pan": seen.to_rig[..., :1], "tilt": seen.to_rig[..., 1:2], "rover": by_rover}
    rates = _rates(shift.pixels_px, rig.cameras[shift.camera].model.size_px).reshape(-1, 4)
    return {
        name: np.asarray(np.linalg.lstsq(rates, np.nan_to_num(moved).reshape(len(rates), -1), rcond=None)[0])
        for name, moved in moved_px.items()
    }


def _ranges_m(origins_m: FloatArray, directions: FloatArray) -> FloatArray:
    """How far rays (n, 3) of the rover frame go to level ground at z = 0; where they do not, to far away."""
    down = directions[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = np.where((down > 0.0) & (origins_m[:, 2] < 0.0), -origins_m[:, 2] / down, FARTHEST_M)
    return np.asarray(np.clip(ranges, NEAREST_M, FARTHEST_M))


def _rates(pixels: FloatArray, size_px: tuple[int, int]) -> FloatArray:
    """(n, 2, 4): how pixels follow shift x, y, turn and scale of their picture."""
    arm = pixels - (np.array(size_px) - 1.0) / 2.0
    rates = np.zeros((len(pixels), 2, 4))
    rates[:, 0, 0] = rates[:, 1, 1] = 1.0
    rates[:, 0, 2], rates[:, 1, 2] = -arm[:, 1], arm[:, 0]
    rates[:, :, 3] = arm
    return rates


def seen_again(camera: CameraModel, then: Grey, now: Grey) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return features of a camera's picture (n, 2), how far they have moved until another one of it (n, 2),
    and its sigma (n,), all in pixels."""
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
            match = match_patch(
                PosedImage(then, camera), corner, plane, PosedImage(now, camera), SEARCH_PX, _SETTINGS
            )
        except CalibError:
            continue
        if match.verdict == "good":
            pixels.append(corner)
            moved.append(match.pixel_px - corner)
            sigmas.append(float(np.hypot(np.sqrt(np.trace(match.covariance_px2) / 2.0), FLOOR_PX)))
    count = len(pixels)
    return np.reshape(pixels, (count, 2)), np.reshape(moved, (count, 2)), np.array(sigmas)
