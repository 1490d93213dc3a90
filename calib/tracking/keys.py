"""The key picture of a followed target: how its camera stood to it, and when another takes its place.

It is renewed when scale or view have changed, not at every step: each renewal hands on its error.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from calib.camera.cahvor import CameraModel
from calib.handoff.by_image import Eye
from calib.pictures.epipolar import normal_seen
from calib.pictures.patch_verdict import PatchMatch
from calib.pictures.warp import Plane
from calib.rigid import FloatArray, Rigid
from calib.tracking.track import Key, Track, TrackSettings


def anchored(track: Track) -> Key | None:
    """The key with its camera shifted so that the target's ray meets the believed position.

    Rover motion is never exact: what counts is how the key camera stood to the target, and the shift across
    the ray is small beside the range.
    """
    camera = track.key.eye.camera
    ray = camera.ray(track.key.pixel_px)
    between = track.position_m - ray.origins_m
    along = float(between @ ray.directions)
    if not bool(ray.valid) or along <= 0:
        return None
    shift = Rigid(np.eye(3), between - along * ray.directions)
    return replace(track.key, eye=replace(track.key.eye, camera=camera.moved(shift)))


def fresh_key(
    key: Key,
    eyes: Mapping[str, Eye],
    good: Mapping[str, PatchMatch],
    plane: Plane,
    slope: Plane | None,
) -> Key | None:
    """A key from the pictures of this look; None if one eye alone saw the target.

    ``slope`` is the surface that one eye asked through the other told. Without it both were asked through the
    key, over ``plane``, and tell the surface together.
    """
    if len(good) < 2:
        return None
    first, second = list(eyes)[:2]
    left, right = good[first], good[second]
    surface = slope or plane
    normal = surface.normal
    if slope is None:
        normal = normal_seen(plane.point_m, eyes[first].camera, eyes[second].camera, plane, right, left)
    drift = key.drift_m2 + on_surface(left.covariance_px2, eyes[first].camera, surface)
    return Key(eyes[first], left.pixel_px, normal, drift)


def on_surface(covariance_px2: FloatArray, camera: CameraModel, plane: Plane) -> FloatArray:
    """A pixel's covariance (2, 2) as that of its place on the surface (3, 3), square metres."""
    _, rate, _ = camera.project_jacobian(plane.point_m)
    to_surface = plane.axes @ np.linalg.inv(rate @ plane.axes)
    return np.asarray(to_surface @ covariance_px2 @ to_surface.T)


def outgrown(
    key: Key, eyes: Mapping[str, Eye], good: Mapping[str, PatchMatch], plane: Plane, settings: TrackSettings
) -> bool:
    """Whether scale, view or light have changed so much that the key should be exchanged."""
    scale, shape = _seen_larger(next(iter(eyes.values())).camera, key.eye.camera, plane)
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


def drifted_m(key: Key) -> float:
    """One sigma, metres, of the drift that the keys before handed on, in its worst direction."""
    return math.sqrt(max(float(np.linalg.eigvalsh(key.drift_m2)[-1]), 0.0))
