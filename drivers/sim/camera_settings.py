"""How the simulated cameras of a rover take pictures, and which of that can be."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

from drivers.errors import BadOptions
from drivers.sim.optics.exposure import ExposureSettings
from drivers.sim.optics.lens import LensSettings


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
    lens, exposure
        What their classes say.
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


def check_cameras(settings: CameraSettings, rows: int) -> None:
    """Pass settings that can be.

    Parameters
    ----------
    settings
        To be checked.
    rows
        Of the largest picture.

    Raises
    ------
    BadOptions
        Naming the key, its value, and what would be right.
    """
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
