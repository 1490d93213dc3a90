"""Where a camera should show a point, and how surely."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from calib.geometry.cahvor import CameraModel

STEP_M = 1e-3  # of the differences; a camera's curvature over it is far below a pixel
LEAST_SIGMA_PX = 0.05


def in_picture(camera: CameraModel, position_m: ArrayLike, covariance_m2: object) -> dict[str, float] | None:
    """Return the pixel of a point and one sigma of it as an ellipse.

    Parameters
    ----------
    camera
        In the frame of the point.
    position_m, covariance_m2
        (3,) metres and (3, 3) m²; None for a point whose covariance is not known: then the ellipse is none.

    Returns
    -------
    dict or None
        ``x_px``, ``y_px``, ``major_px``, ``minor_px`` (half axes), ``turn_rad`` (of the major one, from x
        towards y); None if the camera does not show the point.
    """
    point = np.asarray(position_m, dtype=float)
    places, valid = camera.project(np.vstack([point, point + STEP_M * np.eye(3)]))
    if not bool(np.all(valid)) or not camera.holds(places[0]):
        return None
    told = {"x_px": float(places[0, 0]), "y_px": float(places[0, 1])}
    if covariance_m2 is None:
        return told | {"major_px": 0.0, "minor_px": 0.0, "turn_rad": 0.0}
    rates = (places[1:] - places[0]).T / STEP_M
    variances, axes = np.linalg.eigh(rates @ np.asarray(covariance_m2, dtype=float) @ rates.T)
    minor, major = (max(LEAST_SIGMA_PX, math.sqrt(max(0.0, one))) for one in variances.tolist())
    return told | {
        "major_px": major, "minor_px": minor, "turn_rad": math.atan2(axes[1, 1], axes[0, 1])
    }  # fmt: skip
