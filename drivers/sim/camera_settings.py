"""How the simulated cameras take pictures, when each exposes, and what a day's temperature does to them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from calib.files.records import problem
from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid, rot_y, rot_z
from drivers.options import DriverOptions
from drivers.sim.optics.exposure import ExposureSettings
from drivers.sim.optics.lens import LensSettings

_ROUNDING_S = 1e-9
"""A frame stamped at the requested moment is not after it, whatever rounding does on the way."""

STEP_K = 1 / 16
"""Temperatures are taken in such steps, since every other camera model costs the renderer a table of rays: at
the default coefficients a step moves a picture's corner by 0.006 px."""


class CameraSettings(DriverOptions):
    """How a simulated camera takes pictures."""

    rate_hz: Annotated[float, Field(gt=0.0, le=1e4)] = 10.0
    """Frames a second."""
    exposure_s: Annotated[float, Field(gt=0.0, le=1e3)] = 0.008
    """Exposure time."""
    readout_s: Annotated[float, Field(ge=0.0, le=1e3)] = 0.02
    """From the end of an exposure until the frame can be had."""
    read_noise_dn: Annotated[float, Field(ge=0.0, le=255.0)] = 1.0
    """Standard deviation of the noise in the dark, grey levels of 0..255."""
    shot_noise_dn: Annotated[float, Field(ge=0.0, le=255.0)] = 1.7
    """Standard deviation that light adds at mid grey (128); grows as the root of the grey level."""
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = 1
    """Of the noise; with the camera's name and the sequence number it fixes every pixel."""
    smear: bool = False
    """Whether what moves during an exposure is drawn as often as it takes for views less than a pixel
    apart."""
    row_time_s: Annotated[float, Field(ge=0.0, le=0.001)] = 0.0
    """Rolling shutter: from the exposure of one row to that of the next; 0: all rows at once."""
    colour: bool = False
    """Whether pixels lie under red, green and blue filters, and pictures are (h, w, 3) BGR."""
    jpeg_quality: Annotated[int, Field(ge=0, le=100)] = 0
    """Of the frames as they come, 1 to 100; 0: they come as they are."""
    lens: LensSettings = LensSettings()
    """Falloff, blur and dust."""
    exposure: ExposureSettings = ExposureSettings()
    """How grey levels follow time and gain."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        exposure, lens = self.exposure, self.lens
        if exposure.auto and not exposure.reference_s:
            raise problem("exposure.auto", "it needs exposure.reference_s above 0: grey levels follow it")
        if exposure.auto and exposure.shortest_s > exposure.longest_s:
            message = f"{exposure.shortest_s:g} is above longest_s {exposure.longest_s:g}"
            raise problem("exposure.shortest_s", message)
        if lens.f_number and 0 < lens.focus_m < 0.1:
            raise problem(
                "lens.focus_m", f"{lens.focus_m:g} where 0 (infinitely far) or 0.1 or more is expected"
            )
        if message := self.misfit(rows=1):
            raise problem("", message)
        return self

    def misfit(self, rows: int) -> str:
        """Return why a picture of so many rows does not fit the rate; empty if it does."""
        longest_s = max(self.exposure_s, self.exposure.longest_s if self.exposure.auto else 0.0)
        all_rows_s = longest_s + (rows - 1) * self.row_time_s
        if all_rows_s < 1 / self.rate_hz:
            return ""
        what = f"exposure_s {self.exposure_s:g}"
        if all_rows_s != self.exposure_s:
            what = f"{all_rows_s:g} s for all rows of a picture"
        return f"{what} does not fit rate_hz {self.rate_hz:g}"


class ClockSettings(DriverOptions):
    """When one camera exposes, and what its stamps are worth."""

    offset_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """How much later than the others' its first frame is exposed."""
    drift_ppm: Annotated[float, Field(ge=-500.0, le=500.0)] = 0.0
    """How much faster its clock is."""
    own_stamps: bool = True
    """Whether that clock stamps its frames too; else the host's does, as the kernel's for V4L2 cameras."""
    stamped_late_s: Annotated[float, Field(ge=-1.0, le=1.0)] = 0.0
    """How much later than the exposure its stamps are; the negative of it is what the camera's ``offset_s``
    in a configuration should be."""


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


class TemperatureSettings(DriverOptions):
    """What a day's temperature does to the cameras; with amplitude 0 nothing changes."""

    amplitude_k: Annotated[float, Field(ge=0.0, le=100.0)] = 0.0
    """Of the temperature about its mean."""
    period_s: Annotated[float, Field(ge=1.0, le=1e6)] = 86400.0
    """A day."""
    phase_rad: Annotated[float, Field(ge=-6.2832, le=6.2832)] = 0.0
    """Of the sine at the start; 0: the mean, getting warmer."""
    focal_ppm_per_k: Annotated[float, Field(ge=-1000.0, le=1000.0)] = -31.0
    """How much longer the focal lengths get."""
    centre_x_px_per_k: Annotated[float, Field(ge=-1.0, le=1.0)] = 0.05
    """How far the images' centres move to the right; in right cameras, which are mounted as in a mirror, to
    the left."""
    centre_y_px_per_k: Annotated[float, Field(ge=-1.0, le=1.0)] = 0.05
    """How far they move down."""
    mount_tilt_rad_per_k: Annotated[float, Field(ge=-0.001, le=0.001)] = 2e-5
    """How far the head leans up, behind its joints."""
    mount_pan_rad_per_k: Annotated[float, Field(ge=-0.001, le=0.001)] = 1e-5
    """How far it turns right."""

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
