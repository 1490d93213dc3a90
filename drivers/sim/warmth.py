"""What a day's temperature does to lenses and to the head's mount, as a pure function of time.

The mast file was made at the mean temperature. Away from it a lens has another focal length, its barrel sits
elsewhere before the sensor, and the bracket that carries the head bends.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid, rot_y, rot_z
from drivers.sim.section import check_bounds, filled

STEP_K = 1 / 16
"""Temperatures are taken in such steps, since every other camera model costs the renderer a table of rays: at
the default coefficients a step moves a picture's corner by 0.006 px."""

_BOUNDS: Mapping[str, tuple[float, float]] = {
    "amplitude_k": (0.0, 100.0),
    "period_s": (1.0, 1e6),
    "phase_rad": (-6.2832, 6.2832),
    "focal_ppm_per_k": (-1000.0, 1000.0),
    "centre_x_px_per_k": (-1.0, 1.0),
    "centre_y_px_per_k": (-1.0, 1.0),
    "mount_tilt_rad_per_k": (-0.001, 0.001),
    "mount_pan_rad_per_k": (-0.001, 0.001),
}


@dataclass(frozen=True)
class TemperatureSettings:
    """The ``temperature`` section of a simulation; with amplitude 0 nothing changes.

    Attributes
    ----------
    amplitude_k
        From the day's mean to its extremes, kelvin.
    period_s
        Length of a day.
    phase_rad
        Of the sine at the start; 0: the mean, getting warmer.
    focal_ppm_per_k
        How much longer the focal lengths get.
    centre_x_px_per_k, centre_y_px_per_k
        How far the images' centres move to the right and down; in right eyes, which are mounted as in a
        mirror, to the left.
    mount_tilt_rad_per_k, mount_pan_rad_per_k
        How far the head leans up, and turns right, behind its joints.
    """

    amplitude_k: float = 0.0
    period_s: float = 86400.0
    phase_rad: float = 0.0
    focal_ppm_per_k: float = -31.0
    centre_x_px_per_k: float = 0.05
    centre_y_px_per_k: float = 0.05
    mount_tilt_rad_per_k: float = 2e-5
    mount_pan_rad_per_k: float = 1e-5

    def change_k(self, passed_s: float) -> float:
        """Return by how much it is warmer than the mean, kelvin, in whole steps."""
        warmer = self.amplitude_k * math.sin(math.tau * passed_s / self.period_s + self.phase_rad)
        return STEP_K * round(warmer / STEP_K)

    def camera(self, model: CameraModel, is_right: bool, change_k: float) -> CameraModel:
        """Return a camera as it is at a temperature; itself at the mean.

        The vectors' parts along A are the image centre, those across it the focal lengths (Yakimovsky and
        Cunningham, 1978).
        """
        if change_k == 0:
            return model
        longer = 1 + 1e-6 * self.focal_ppm_per_k * change_k
        moved = {}
        x_px = self.centre_x_px_per_k * change_k * (-1 if is_right else 1)
        for letter, by_px in (("H", x_px), ("V", self.centre_y_px_per_k * change_k)):
            vector = getattr(model, letter)
            centre_px = float(np.dot(model.A, vector))
            moved[letter] = longer * (vector - centre_px * model.A) + (centre_px + by_px) * model.A
        return replace(model, **moved)

    def mount(self, change_k: float) -> Rigid:
        """Return how the head, behind its joints, has turned at a temperature."""
        turned = rot_z(self.mount_pan_rad_per_k * change_k) @ rot_y(self.mount_tilt_rad_per_k * change_k)
        return Rigid(turned, np.zeros(3))


def temperature_settings(values: Any) -> TemperatureSettings:
    """Return what a configuration says of the day. Raises BadOptions."""
    day: TemperatureSettings = filled(TemperatureSettings(), values, "simulation.temperature")
    check_bounds(day, _BOUNDS, "simulation.temperature")
    return day
