"""How the simulated cameras take pictures, when each exposes, and what a day's temperature does to them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

import numpy as np

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid, rot_y, rot_z
from drivers.errors import BadOptions
from drivers.options import check_bounds, filled
from drivers.sim.optics.exposure import ExposureSettings
from drivers.sim.optics.lens import LensSettings

BOUNDS = {
    "jpeg_quality": (0, 100),
    "row_time_s": (0, 0.001),
    "lens.falloff": (0, 8),
    "lens.pitch_um": (0.5, 50),
    "lens.dust": (0, 500),
    "lens.dust_um": (1, 1000),
    "lens.dust_gap_um": (0, 10_000),
    "exposure.gain": (1, 64),
    "exposure.target_dn": (10, 245),
    "exposure.share": (0.01, 1),
    "exposure.lag_frames": (1, 8),
    "exposure.shortest_s": (1e-6, 10),
    "exposure.most_gain": (1, 64),
    "exposure.night_share": (0, 1),
}
"""Lowest and highest value; of all others 0 or more."""

CLOCK_BOUNDS: Mapping[str, tuple[float, float]] = {
    "offset_s": (0.0, 1.0),
    "drift_ppm": (-500.0, 500.0),
    "stamped_late_s": (-1.0, 1.0),
}

_ROUNDING_S = 1e-9
"""A frame stamped at the asked moment is not after it, whatever rounding does on the way."""

STEP_K = 1 / 16
"""Temperatures are taken in such steps, since every other camera model costs the renderer a table of rays: at
the default coefficients a step moves a picture's corner by 0.006 px."""

DAY_BOUNDS: Mapping[str, tuple[float, float]] = {
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
class CameraSettings:
    """How a simulated camera takes pictures.

    Attributes
    ----------
    rate_hz
        Frames a second.
    exposure_s, readout_s
        Exposure time, and the time from its end until the frame can be had.
    read_noise_dn
        Standard deviation of the noise in the dark, grey levels of 0..255.
    shot_noise_dn
        Standard deviation that light adds at mid grey (128); grows as the root of the grey level.
    seed
        Of the noise; with the camera's name and the sequence number it fixes every pixel.
    smear
        Whether what moves during an exposure is drawn as often as it takes for views less than a pixel apart.
    row_time_s
        Rolling shutter: from the exposure of one row to that of the next; 0: all rows at once.
    colour
        Whether pixels lie under red, green and blue filters, and pictures are (h, w, 3) BGR.
    jpeg_quality
        Of the frames as they come, 1 to 100; 0: they come as they are.
    """

    rate_hz: float = 10.0
    exposure_s: float = 0.008
    readout_s: float = 0.02
    read_noise_dn: float = 1.0
    shot_noise_dn: float = 1.7
    seed: int = 1
    smear: bool = False
    row_time_s: float = 0.0
    colour: bool = False
    jpeg_quality: int = 0
    lens: LensSettings = field(default_factory=LensSettings)
    exposure: ExposureSettings = field(default_factory=ExposureSettings)


def check_cameras(settings: CameraSettings, rows: int) -> None:
    """Pass settings that can be. Raises BadOptions naming the key, its value, and what would be right."""
    _check_numbers(settings, "")
    key, exposure, lens = "simulation.cameras", settings.exposure, settings.lens
    if exposure.auto and not exposure.reference_s:
        raise BadOptions(f"{key}.exposure.auto needs exposure.reference_s above 0: grey levels follow it")
    if exposure.auto and exposure.shortest_s > exposure.longest_s:
        raise BadOptions(
            f"{key}.exposure.shortest_s {exposure.shortest_s:g} is above longest_s {exposure.longest_s:g}"
        )
    if lens.f_number and 0 < lens.focus_m < 0.1:
        raise BadOptions(
            f"{key}.lens.focus_m is {lens.focus_m:g}, expected 0 (infinitely far) or 0.1 or more"
        )
    longest_s = max(settings.exposure_s, exposure.longest_s if exposure.auto else 0.0)
    all_rows_s = longest_s + (rows - 1) * settings.row_time_s
    if settings.rate_hz <= 0 or not settings.exposure_s > 0 or not all_rows_s < 1 / settings.rate_hz:
        what = f"exposure_s {settings.exposure_s:g}"
        if all_rows_s != settings.exposure_s:
            what = f"{all_rows_s:g} s for all rows of a picture"
        raise BadOptions(f"{key}: {what} does not fit rate_hz {settings.rate_hz:g}")


def _check_numbers(settings: Any, prefix: str) -> None:
    for f in fields(settings):
        value, key = getattr(settings, f.name), prefix + f.name
        if is_dataclass(value):
            _check_numbers(value, f"{key}.")
            continue
        low, high = BOUNDS.get(key, (0, math.inf))
        if not low <= value <= high:
            wanted = f"{low:g} or more" if high == math.inf else f"{low:g} to {high:g}"
            raise BadOptions(f"simulation.cameras.{key} is {value!r}, expected {wanted}")


@dataclass(frozen=True)
class ClockSettings:
    """One camera's entry in the ``clocks`` section of a simulation.

    Attributes
    ----------
    offset_s
        How much later than the others' its first frame is exposed.
    own_stamps
        Whether that clock stamps them too; else the host's does, as the kernel's for V4L2 cameras.
    stamped_late_s
        How much later than the exposure its stamps are; the negative of it is what the camera's ``offset_s``
        in a configuration should be.
    """

    offset_s: float = 0.0
    drift_ppm: float = 0.0
    own_stamps: bool = True
    stamped_late_s: float = 0.0


def clock_settings(values: Any) -> dict[str, ClockSettings]:
    """Return what a configuration says of cameras' clocks, by name. Raises BadOptions."""
    if not isinstance(values, Mapping):
        raise BadOptions(f"simulation.clocks is {values!r}, expected keys and values by camera's name")
    clocks: dict[str, ClockSettings] = {}
    for name, entry in values.items():
        own: ClockSettings = filled(ClockSettings(), entry, f"simulation.clocks.{name}")
        check_bounds(own, CLOCK_BOUNDS, f"simulation.clocks.{name}")
        clocks[str(name)] = own
    return clocks


class SimulatedCameraClock:
    """Turns true times into stamps and back; both agree at ``start_s`` but for ``stamped_late_s``."""

    def __init__(self, settings: ClockSettings, start_s: float) -> None:
        self._pace = 1 + 1e-6 * settings.drift_ppm
        self._drift = 1e-6 * settings.drift_ppm if settings.own_stamps else 0.0
        self._late_s = settings.stamped_late_s
        self._start_s = start_s
        self.first_s = start_s + settings.offset_s
        """When frame 0 is exposed."""

    def true_period_s(self, period_s: float) -> float:
        """Return how long a period by this clock truly is."""
        return period_s / self._pace

    def stamp_s(self, true_s: float) -> float:
        """Return what stands on a frame of a moment."""
        return true_s + ((true_s - self._start_s) * self._drift + self._late_s)

    def true_s(self, stamp_s: float) -> float:
        """Return the moment that a stamp means, and a nanosecond for rounding."""
        since_s = stamp_s - self._late_s - self._start_s
        return stamp_s - (since_s * self._drift / (1 + self._drift) + self._late_s) + _ROUNDING_S


@dataclass(frozen=True)
class TemperatureSettings:
    """The ``temperature`` section of a simulation; with amplitude 0 nothing changes.

    Attributes
    ----------
    phase_rad
        Of the sine at the start; 0: the mean, getting warmer.
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
    check_bounds(day, DAY_BOUNDS, "simulation.temperature")
    return day
