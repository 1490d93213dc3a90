"""One camera's knowledge of a target: a line of sight, and how far along it the target may be.

What is estimated is the inverse range, 1/m: the pixel of a far target in another view depends on it almost
linearly, and infinity is 0. What another view of the same thing shows (of the same camera, once the head has
turned, if it is off the axes) says more about it, by as much as the two views stand apart and no more than
mast file, joint readings and matches allow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from calib.errors import CalibError
from calib.geometry.covariance import JOINT_NAMES, RIG_PX, RigCovariance, pixel_rates, place_rates
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, ReadOnlyArrays, frozen_array

NORMAL_95 = 1.96
FARTHEST_M = 1e5
"""The assumed range of a target whose range cannot be measured."""


@dataclass(frozen=True, eq=False)
class Sight(ReadOnlyArrays):
    """A pixel (2,) of a camera's picture at true (pan, tilt), and what is known of the range that it shows.

    ``inverse_m`` is 1/range from the ray's origin; a sigma of 0: the range was given.
    """

    camera: str
    joints_rad: tuple[float, float]
    pixel_px: FloatArray
    inverse_m: float
    inverse_sigma_m: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "pixel_px", frozen_array(self.pixel_px, (2,)))

    @property
    def range_m(self) -> float:
        """The likeliest range, `FARTHEST_M` at most."""
        return 1.0 / max(self.inverse_m, 1.0 / FARTHEST_M)

    @property
    def range_interval_m(self) -> tuple[float, float | None]:
        """The ranges that are 95 % likely; None for infinity."""
        near = self.inverse_m + NORMAL_95 * self.inverse_sigma_m
        far = self.inverse_m - NORMAL_95 * self.inverse_sigma_m
        return 1.0 / max(near, 1.0 / FARTHEST_M), None if far <= 1.0 / FARTHEST_M else 1.0 / far

    def position_m(self, rig: Rig) -> FloatArray:
        """Return the likeliest place (3,) of the target, rover frame. Raises CalibError."""
        origin, direction = _ray(rig, self)
        return origin + self.range_m * direction


@dataclass(frozen=True, eq=False)
class SeenFrom:
    """Where a view should show what a sight is of: the pixel (2,) at the likeliest range.

    ``along_px_m`` (2,) is how it moves with the inverse range, px for 1/m, ``covariance_px2`` (2, 2) that of
    all but the range: the sight's own pixel, mast file, joint readings of both views.
    """

    pixel_px: FloatArray
    along_px_m: FloatArray
    covariance_px2: FloatArray

    def whole_px2(self, inverse_sigma_m: float) -> FloatArray:
        """Return the covariance (2, 2) with the range's part."""
        along = inverse_sigma_m * self.along_px_m
        return self.covariance_px2 + np.outer(along, along)


def unknown_range(nearest_m: float) -> tuple[float, float]:
    """Return inverse range and sigma, 1/m, whose 95 % reach from ``nearest_m`` to infinity."""
    return 0.5 / nearest_m, 0.5 / nearest_m / NORMAL_95


def range_to_plane(
    rig: Rig, camera: str, joints_rad: tuple[float, float], pixel_px: FloatArray, point_m: FloatArray,
    normal: FloatArray,
) -> float:  # fmt: skip
    """Return the range, metres, at which a pixel's ray meets a plane of the rover frame.

    Raises CalibError if the pixel has no ray, or its ray goes along the plane or away from it.
    """
    origin, direction = _ray(rig, Sight(camera, joints_rad, pixel_px, 0.0, 0.0))
    towards = float(direction @ normal) / float(np.linalg.norm(normal))
    away = float((point_m - origin) @ normal) / float(np.linalg.norm(normal))
    if abs(towards) < 1e-3 or not 0.0 < away / towards < FARTHEST_M:
        raise CalibError(f"the ray of pixel {_text(pixel_px)} of {camera} does not meet the plane")
    return away / towards


def seen_from(
    rig: Rig,
    sight: Sight,
    camera: str,
    joints_rad: tuple[float, float],
    *,
    sigma_px: float,
    sigma_rad: tuple[float, float] = (0.0, 0.0),
    calibration: RigCovariance | None = None,
) -> SeenFrom:
    """Return where a camera should show what a sight is of, at true (pan, tilt).

    ``sigma_px`` is that of each coordinate of the sight's pixel, ``sigma_rad`` of each view's readings of pan
    and tilt; of two views at one pose they are the same error. Without a ``calibration`` `RIG_PX` is assumed
    for a view at other joint angles. Raises CalibError if the sight's pixel has no ray, or a camera cannot
    project the place.
    """
    known = calibration.of([sight.camera, camera]) if calibration else RigCovariance((), np.zeros((0, 0)))
    names, size = (*known.names, *JOINT_NAMES), len(known.names)
    _, direction = _ray(rig, sight)
    place_m = sight.position_m(rig)
    try:
        by_click, by_source = place_rates(rig, names, (sight.camera,), *sight.joints_rad, place_m)
        view = pixel_rates(rig, names, camera, *joints_rad, place_m[None])
        if not np.isfinite(view.pixels_px).all():
            raise CalibError
    except CalibError:
        message = f"{camera} cannot see what {sight.camera} sees at {sight.range_m:.3g} m"
        raise CalibError(message) from None
    by_place, by_rig = view.to_points[0], view.to_rig[0]
    along = -(sight.range_m**2) * (by_place @ direction)
    clicked = sigma_px * (by_place @ by_click)
    covariance = clicked @ clicked.T
    if camera != sight.camera or joints_rad != sight.joints_rad:
        first = by_place @ by_source
        turned = np.hstack([first[:, size:], by_rig[:, size:]]) * np.tile(sigma_rad, 2)
        both = first[:, :size] + by_rig[:, :size]
        covariance += turned @ turned.T + both @ known.covariance @ both.T
        covariance += (RIG_PX**2 if calibration is None else 0.0) * np.eye(2)
    return SeenFrom(view.pixels_px[0], along, covariance)


def shown(
    rig: Rig,
    sight: Sight,
    camera: str,
    joints_rad: tuple[float, float],
    pixel_px: FloatArray,
    expected: SeenFrom,
    sigma_px: float,
) -> Sight:
    """Return what is known after a view has shown the thing at a pixel (2,): a sight by that view.

    ``expected`` is what `seen_from` returns, ``sigma_px`` one sigma of each coordinate of the found pixel.
    Raises CalibError as `seen_from`.
    """
    inverse, sigma = sight.inverse_m, sight.inverse_sigma_m
    if sigma > 0.0:
        weight = np.linalg.inv(expected.covariance_px2 + sigma_px**2 * np.eye(2))
        model = rig.camera_in_rover(camera, *joints_rad)
        prior, along = 1.0 / sigma**2, expected.along_px_m
        for _ in range(6):
            at = replace(sight, inverse_m=inverse)
            left = pixel_px - np.asarray(model.project(at.position_m(rig))[0])
            information = prior + float(along @ weight @ along)
            step = (float(along @ weight @ left) + prior * (sight.inverse_m - inverse)) / information
            inverse = max(inverse + step, 0.0)
        sigma = 1.0 / math.sqrt(information)
    origin, direction = _ray(rig, sight)
    new = Sight(camera, joints_rad, pixel_px, 0.0, 0.0)
    new_origin, new_direction = _ray(rig, new)
    cosine = float(direction @ new_direction)
    depth = cosine + inverse * float((origin - new_origin) @ new_direction)
    if not (depth > 0.0 and cosine > 0.0):
        raise CalibError(
            f"the target that {sight.camera} sees at {1 / max(inverse, 1e-5):.3g} m is not before {camera}"
        )
    return replace(new, inverse_m=inverse / depth, inverse_sigma_m=sigma * cosine / depth**2)


def _ray(rig: Rig, sight: Sight) -> tuple[FloatArray, FloatArray]:
    """Origin (3,) and unit direction (3,) of a sight, rover frame."""
    rays = rig.camera_in_rover(sight.camera, *sight.joints_rad).ray(sight.pixel_px)
    if not bool(rays.valid):
        raise CalibError(f"pixel {_text(sight.pixel_px)} of {sight.camera} has no ray")
    return np.asarray(rays.origins_m), np.asarray(rays.directions)


def _text(pixel_px: FloatArray) -> str:
    return f"({pixel_px[0]:g}, {pixel_px[1]:g})"
