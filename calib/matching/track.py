"""A followed target: its place with covariance, the picture it is known by, and how motion carries both.

A motion of the rover carries the target over and adds the motion's own covariance (`moved_track`).
`calib.matching.search` finds it again.

A place is followed only if it differs from its surroundings. A place that correlates with its own
neighbourhood will be confused with it: an edge along its length, a pattern with its repetition. And a patch
with little texture is found again only as long as the light stays: what else it shows is shading, and the
edges of shadows, which move with the sun.

The key picture is renewed when scale or view have changed, not at every step: each renewal hands on its
error.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np

from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import ray_gap, refuse_two_points
from calib.geometry.rigid import FloatArray, Rigid, carried_covariance, rigid_rates
from calib.geometry.stereo import triangulate
from calib.matching.least_squares import gaussian
from calib.matching.partner import find_partner, normal_seen
from calib.matching.patch import (
    MatchSettings,
    PatchMatch,
    match_patch,
    near_covariance,
    near_half_px,
    texture_lacks,
)
from calib.matching.warp import Grey, Plane, PosedImage, patch_grid

State = Literal["tracked", "lost"]

SIZES = MatchSettings(half_px=12, near_px=6.0, roughness=0.04, relief=0.1, worst_ratio=0.7, least_lead=0.03)
"""Smaller patches than a single match takes: seen flat from 10 m, 41 px of ground are 0.8 m long and no
plane, and what lies off the plane pulls the place along as the view steepens. Roughness and relief make nine
in ten and more of the range errors lie within two of the stated sigmas. A second place may fit a little
better than elsewhere: the other camera and the prediction must confirm the best."""


@dataclass(frozen=True)
class TrackSettings:
    """Thresholds of the tracking, with the reasons for their values."""

    sigmas: float = 3.5  # of the prediction, half the width of the search window, and its bounds
    least_px: float = 4.0
    most_px: float = 120.0
    model_px: float = 0.12  # one sigma of what the models are wrong by between two cameras and two pairs
    worst_chi2: float = 18.5
    """Of the innovation, four pixel coordinates against the prior: 1 in 1000 good matches of both cameras is
    above."""
    renew_grown: float = 1.8
    """The key picture is renewed when the target's surface is seen this much larger (or smaller), or
    foreshortened this much otherwise: seen flat, a step nearer shows much that it did not."""
    renew_shrunk: float = 0.3
    renew_shape: float = 1.5
    renew_below: float = 0.8
    """Or when the correlation falls below this: what is seen now is no longer what the key picture shows.
    One camera that sees so little of it does not find a lost target again."""
    worst_drift_m: float = 0.03  # one sigma of the drift from the picked place; beyond it the target is lost


@dataclass(frozen=True, eq=False)
class KeyPicture:
    """The picture that templates are cut from, in the rover frame, and the target's place in it.

    ``drift_m2`` (3, 3) is the covariance, along the surface, of the place followed from the place picked:
    what the keys before handed on.
    """

    view: PosedImage
    pixel_px: FloatArray
    normal: FloatArray
    drift_m2: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass(frozen=True, eq=False)
class Track:
    """A followed target: its place (3,) with covariance (3, 3), in the rover frame of the last motion.

    ``tracked``: the last pictures showed it. ``lost``: they did not. ``standby`` is the key that the last
    pictures of both cameras would have given: what is searched for where the key loses the target, since the
    light has changed or another side shows. None after a renewal. ``misses`` counts searches since it was
    last found, ``motion_covariance`` (6, 6) is that of the rover's motion since then, as `moved_track` takes
    it; it is part of ``covariance_m2``.
    """

    state: State
    position_m: FloatArray
    covariance_m2: FloatArray
    key: KeyPicture
    standby: KeyPicture | None = None
    misses: int = 0
    motion_covariance: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))

    @property
    def target_covariance_m2(self) -> FloatArray:
        """(3, 3) of the target that was picked: of the followed place, and of its drift from the picked one.

        What pixels and motions show; an error that all cameras of the mast file share is not in it, and one
        that two cameras do not share is averaged by pictures from one place as if it were noise.
        """
        return self.covariance_m2 + self.key.drift_m2


def moved_track(track: Track, now_from_then: Rigid, covariance: FloatArray) -> Track:
    """Carry a track over a motion of the rover.

    ``covariance`` (6, 6) of that motion: small rotation (radians), then translation (metres), both in the
    frame of now: true = (1 + rotation) believed + translation. CalibError if it is none.
    """
    spread = np.asarray(covariance, dtype=np.float64)
    if spread.shape != (6, 6) or not np.isfinite(spread).all() or (np.diag(spread) < 0).any():
        raise CalibError(
            "a motion's covariance is 6 rows of 6 finite numbers: rotation in rad², then translation in m²"
        )
    position = now_from_then.points(track.position_m)
    rate, turned = motion_rate(position), now_from_then.rotation
    return replace(
        track,
        position_m=position,
        covariance_m2=turned @ track.covariance_m2 @ turned.T + rate @ spread @ rate.T,
        key=carried(track.key, now_from_then),
        standby=track.standby and carried(track.standby, now_from_then),
        motion_covariance=carried_covariance(track.motion_covariance, now_from_then) + spread,
    )


def motion_rate(position_m: FloatArray) -> FloatArray:
    """Return d position / d motion (3, 6): how a small rotation, then a translation, move a point."""
    return np.asarray(rigid_rates(np.eye(3)[None], position_m[None], np.zeros(3))[0])


def carried(key: KeyPicture, motion: Rigid) -> KeyPicture:
    """The key in another frame."""
    return KeyPicture(
        replace(key.view, camera=key.view.camera.moved(motion)),
        key.pixel_px,
        motion.vectors(key.normal),
        motion.rotation @ key.drift_m2 @ motion.rotation.T,
    )


AROUND_PX = 80
"""How far around is compared: as far as a heading that is wrong by 1.2 degrees puts a target in a Pancam."""
MOST_ALIKE = 0.9
"""Correlation with another place: the simulated rover's rocks and ground were seen to stay below 0.86,
edges of its shadows to have 0.97."""


def indistinct(
    image: Grey, camera: CameraModel, pixel_px: FloatArray, plane: Plane, settings: MatchSettings
) -> str:
    """Return why a target (2,) cannot be distinguished from its surroundings, empty if it can.

    ``plane`` is the surface there; the ``near_px`` of the settings sizes and weighs the patch.
    """
    near_px2 = near_covariance(plane, camera, pixel_px, settings.near_px)
    half = near_half_px(near_px2)
    middle = np.rint(pixel_px).astype(int)
    low, high = middle - half, middle + half + 1
    if (low < 0).any() or (high > image.shape[::-1]).any():
        return "the patch around it is cut by the picture's border"
    patch = image[low[1] : high[1], low[0] : high[0]]
    counts = gaussian(patch_grid((int(half[0]), int(half[1]))) + (middle - pixel_px), near_px2)
    # 0.2: in the worst direction, of what grey noise alone would leave.
    lacking = texture_lacks(patch, replace(settings, flat_sigma_px=0.2), counts)
    if lacking:
        return lacking
    first = np.maximum(low - AROUND_PX, 0)
    around = image[first[1] : high[1] + AROUND_PX, first[0] : high[0] + AROUND_PX]
    scores = cv2.matchTemplate(np.ascontiguousarray(around), patch, cv2.TM_CCOEFF_NORMED)
    x, y = low - first
    beside = settings.apart_px
    scores[max(0, y - beside) : y + beside + 1, max(0, x - beside) : x + beside + 1] = -1.0
    _, alike, _, where = cv2.minMaxLoc(np.nan_to_num(scores, nan=-1.0, posinf=-1.0, neginf=-1.0))
    if alike > MOST_ALIKE:
        away = math.dist(where, (x, y))
        return (
            f"an edge, a smooth place or a repeated pattern: what is {away:.0f} px beside it correlates by "
            f"{alike:.2f}, at most {MOST_ALIKE:g} is allowed"
        )
    return ""


CAMERAS_PX = 0.4
"""One sigma, each pixel coordinate, of what two cameras' models may be wrong by where a track is begun: what
is found 2 px off the epipolar line is another thing, or the mast file is off."""


def start_track(left: PosedImage, right: PosedImage, left_px: FloatArray, sigma_px: float = 0.2) -> Track:
    """Begin a track from a click (2,) in the left picture of a pair, of one moment, in the rover frame.

    ``sigma_px`` of the click says how well the place of what was meant is known. Raises CalibError with the
    reason, if the target cannot be followed: sky, plain surface, an edge, repeated pattern, hidden from the
    other camera, outside the picture.
    """
    pixel = np.asarray(left_px, dtype=np.float64)
    if pixel.shape != (2,) or not np.isfinite(pixel).all():
        raise CalibError(f"target pixel {pixel.tolist()} is not two finite numbers")
    width, height = left.camera.size_px
    if not (0 <= pixel[0] <= width - 1 and 0 <= pixel[1] <= height - 1):
        raise CalibError(
            f"the target pixel ({pixel[0]:.1f}, {pixel[1]:.1f}) is outside the picture of {width} x {height}"
        )
    found = find_partner(left, pixel, right)
    if found.match.verdict != "good" or found.plane is None:
        raise CalibError(f"the target cannot be followed: {found.match.reason}")
    # The patch that shows the surface reaches beyond it on a rock: the range is that of its middle.
    # 4.0: how far the range of a patch's middle may put it from where the whole patch puts it, at the start.
    middle = match_patch(left, pixel, found.plane, right, 4.0, SIZES)
    reason = middle.reason or indistinct(left.image, left.camera, pixel, found.plane, SIZES)
    if reason:
        raise CalibError(f"the target cannot be followed: {reason}")
    noise = max(sigma_px, float(middle.sigma_px.max()))
    seen = triangulate(left.camera, right.camera, pixel, middle.pixel_px, noise)
    gap = ray_gap(seen, (noise**2 + CAMERAS_PX**2) * np.eye(4))
    by = f"a match good to {noise:.2g} px and cameras good to {CAMERAS_PX:g} px"
    try:
        refuse_two_points(gap, ("the left camera", "the right camera"), by)
    except CalibError as error:
        raise CalibError(f"the target cannot be followed: {error}") from None
    key = KeyPicture(left, pixel, found.plane.normal)
    return Track("tracked", seen.position_m, seen.covariance_m2, key)


def anchored(track: Track) -> KeyPicture | None:
    """The key with its camera shifted so that the target's ray meets the believed position.

    Rover motion is never exact: what counts is how the key camera stood to the target, and the shift across
    the ray is small beside the range.
    """
    camera = track.key.view.camera
    ray = camera.ray(track.key.pixel_px)
    between = track.position_m - ray.origins_m
    along = float(between @ ray.directions)
    if not bool(ray.valid) or along <= 0:
        return None
    shift = Rigid(np.eye(3), between - along * ray.directions)
    return replace(track.key, view=replace(track.key.view, camera=camera.moved(shift)))


def fresh_key(
    key: KeyPicture,
    images: Mapping[str, PosedImage],
    good: Mapping[str, PatchMatch],
    plane: Plane,
    slope: Plane | None,
) -> KeyPicture | None:
    """A key from new pictures; None if one camera alone saw the target.

    ``slope`` is the surface from a search of one camera by the other. Without it both were searched by the
    key, over ``plane``, and show the surface together.
    """
    if len(good) < 2:
        return None
    first, second = list(images)[:2]
    left, right = good[first], good[second]
    surface = slope or plane
    normal = surface.normal
    if slope is None:
        normal = normal_seen(plane.point_m, images[first].camera, images[second].camera, plane, right, left)
    drift = key.drift_m2 + on_surface(left.covariance_px2, images[first].camera, surface)
    return KeyPicture(images[first], left.pixel_px, normal, drift)


def on_surface(covariance_px2: FloatArray, camera: CameraModel, plane: Plane) -> FloatArray:
    """A pixel's covariance (2, 2) as that of its place on the surface (3, 3), square metres."""
    _, rate, _ = camera.project_jacobian(plane.point_m)
    to_surface = plane.axes @ np.linalg.inv(rate @ plane.axes)
    return np.asarray(to_surface @ covariance_px2 @ to_surface.T)


def outgrown(
    key: KeyPicture,
    images: Mapping[str, PosedImage],
    good: Mapping[str, PatchMatch],
    plane: Plane,
    settings: TrackSettings,
) -> bool:
    """Whether scale, view or light have changed so much that the key should be exchanged."""
    scale, shape = _seen_larger(next(iter(images.values())).camera, key.view.camera, plane)
    alike = min(one.correlation for one in good.values()) >= settings.renew_below
    return not (
        settings.renew_shrunk < scale < settings.renew_grown and shape < settings.renew_shape and alike
    )


def _seen_larger(camera: CameraModel, key: CameraModel, plane: Plane) -> tuple[float, float]:
    """How much larger a camera sees the target's surface than the key's did, and how much another shape."""
    rates = [one.project_jacobian(plane.point_m) for one in (camera, key)]
    if not all(bool(valid) for _, _, valid in rates):
        return math.nan, math.nan
    now, then = (rate @ plane.axes for _, rate, _ in rates)
    larger, smaller = np.linalg.svd(now @ np.linalg.inv(then), compute_uv=False).tolist()
    return math.sqrt(larger * smaller), larger / smaller


def drifted_m(key: KeyPicture) -> float:
    """One sigma, metres, of the drift that the keys before handed on, in its worst direction."""
    return math.sqrt(max(float(np.linalg.eigvalsh(key.drift_m2)[-1]), 0.0))
