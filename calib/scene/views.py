"""A picture with the camera that took it and where the head stood; which pictures overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.camera.cahvor import CameraModel
from calib.mast.joints import UNKNOWN, Approach
from calib.mast.rig import Rig
from calib.pictures.warp import Grey

FARTHEST_M, NEAREST_M = 1e3, 1.5
LEAST_OVERLAP = 0.02
ASIDE_RAD = 0.5
"""By how much what is near looks to be elsewhere for a camera beside or below."""

_GRID = 12


@dataclass(frozen=True, eq=False)
class View:
    """One picture of the scene.

    Attributes
    ----------
    name, camera
        Of the picture, and of its camera in the rig.
    image
        (h, w) grey.
    pan_rad, tilt_rad, approach
        What the joints read, and from which side they came to rest.
    pose
        Number of the head's rest; pictures of several cameras share one.
    """

    name: str
    camera: str
    image: Grey
    pan_rad: float
    tilt_rad: float
    pose: int
    approach: Approach = UNKNOWN

    def model(self, rig: Rig) -> CameraModel:
        """Return the camera in the rover frame as a rig has it."""
        return rig.camera_in_rover(
            self.camera, *rig.joints.true_rad((self.pan_rad, self.tilt_rad), self.approach)
        )


def overlapping(models: Sequence[CameraModel]) -> dict[tuple[int, int], float]:
    """Return by which part pictures overlap, of cameras in the rover frame; for those that do at all."""
    ahead = np.array([model.A for model in models])
    half = np.array([_half_width_rad(model) for model in models])
    apart = np.arccos(np.clip(ahead @ ahead.T, -1.0, 1.0))
    found = {}
    for first, second in np.argwhere(np.triu(apart < half[:, None] + half + ASIDE_RAD, 1)).tolist():
        one, other = models[first], models[second]
        part = max(overlap(one, other), overlap(other, one))
        if part >= LEAST_OVERLAP:
            found[first, second] = part
    return found


def _half_width_rad(model: CameraModel) -> float:
    """How far a picture's corner is from A."""
    x, y = np.array(model.size_px) - 1.0
    rays = model.ray(np.array([[0.0, 0.0], [x, 0.0], [0.0, y], [x, y]]))
    seen = rays.directions[rays.valid]
    return float(np.arccos(np.clip(seen @ model.A, -1.0, 1.0)).max()) if len(seen) == 4 else np.pi


def overlap(one: CameraModel, other: CameraModel) -> float:
    """Return the part of ``one``'s picture that ``other`` sees, at the better of a near and a far range."""
    width, height = one.size_px
    x, y = np.meshgrid(np.linspace(0, width - 1, _GRID), np.linspace(0, height - 1, _GRID))
    rays = one.ray(np.stack([x.ravel(), y.ravel()], axis=1))
    best = 0.0
    for range_m in (4.0, FARTHEST_M):
        pixels, valid = other.project(rays.origins_m + range_m * rays.directions)
        size = np.array(other.size_px)
        with np.errstate(invalid="ignore"):
            inside = valid & rays.valid & ((pixels >= 0) & (pixels <= size - 1)).all(axis=1)
        best = max(best, float(inside.mean()))
    return best
