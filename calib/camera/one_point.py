"""The one point that a believed position and the pixels of cameras mean, and how badly they fit it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from calib.camera.cahvor import CameraModel
from calib.rigid import FloatArray

STEPS = 20
"""Gauss-Newton steps at most: near a camera the first ones are long..."""
ENOUGH = 1e-4
"""...and the step, in sigmas of the point, after which no more are made."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """A pixel (2,) with its covariance (2, 2), px², in a camera of the point's frame."""

    camera: CameraModel
    pixel_px: FloatArray
    covariance_px2: FloatArray


@dataclass(frozen=True, eq=False)
class OnePoint:
    """The point (3,), metres, its covariance (3, 3), and the weighted sum of squares of what is left over."""

    position_m: FloatArray
    covariance_m2: FloatArray
    chi2: float


def one_point(
    believed_m: FloatArray, covariance_m2: FloatArray, sightings: Iterable[Sighting], model_px: float
) -> OnePoint | None:
    """Return the point that fits a believed position and pixels best, by least squares.

    Parameters
    ----------
    believed_m, covariance_m2
        (3,) and (3, 3), in the cameras' common frame.
    sightings
        What the cameras see.
    model_px
        One sigma of what each camera's model is wrong by, added to each pixel.

    Returns
    -------
    point
        None if a camera cannot see where the point comes to lie, or the steps do not settle.
    """
    seen = list(sightings)
    weights = [np.linalg.inv(one.covariance_px2 + model_px**2 * np.eye(2)) for one in seen]
    prior = np.linalg.inv(covariance_m2 + 1e-12 * np.eye(3))
    position, normal, chi2 = believed_m.copy(), prior, 0.0
    for _ in range(STEPS):
        off = believed_m - position
        normal, right, chi2 = prior.copy(), prior @ off, float(off @ prior @ off)
        for one, weight in zip(seen, weights, strict=True):
            pixel, rate, valid = one.camera.project_jacobian(position)
            if not bool(valid):
                return None
            rest = one.pixel_px - pixel
            normal += rate.T @ weight @ rate
            right += rate.T @ weight @ rest
            chi2 += float(rest @ weight @ rest)
        step = np.linalg.solve(normal, right)
        position = position + step
        if step @ right < ENOUGH**2:
            return OnePoint(position, np.linalg.inv(normal), chi2)
    return None
