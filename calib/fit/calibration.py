"""What a calibration gives: the rig, how sure it is, what was left out and what remains unexplained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from calib.fit.components import Component
from calib.fit.left_out_boards import LeftOutBoard
from calib.fit.wider import WiderModel
from calib.mast.rig import Rig
from calib.rigid import FloatArray, Rigid

HELD_FIXED = (
    "R0 of every camera is held at 0: whatever it does, A, H and V do as well",
    "an offset of pan is no parameter: it is the mast's rotation z",
    "an offset of tilt is no parameter: it turns all head cameras together, which their own axes do as well",
)
"""What no survey of any kind can tell from other parameters, and which of them stands for it."""


@dataclass(frozen=True, eq=False)
class Outlier:
    """A measurement that was not used, and the test it failed.

    Attributes
    ----------
    kind
        What it is.
    name
        Which one: ``image navcam_left-012``, ``image navcam_left-012 dot (row 3, column 4)``,
        ``tape b of placement far-2 (set-up level)``, ``prism p3 of set-up level``.
    statistic, limit
        Sum of squares of its standardised residuals, and what it was allowed to be: at the stated rate of
        false alarms, wider where the typical measurement is farther off than its sigma says. Not-a-number
        for an image that was left out with its board's tapes.
    size
        How far off it is: pixels (rms over an image) or metres. Not-a-number for an image whose board,
        as it is named, the camera cannot see.
    """

    kind: Literal["dot", "image", "tape", "prism"]
    name: str
    statistic: float
    limit: float
    size: float

    @property
    def sentence(self) -> str:
        """The outlier in words."""
        if not np.isfinite(self.size):
            return f"{self.name} cannot show the board that it names and was not used"
        off = f"{self.size:.2f} px" if self.kind in ("dot", "image") else f"{1000 * self.size:.1f} mm"
        return f"{self.name} is off by {off} and was not used"


@dataclass(frozen=True, eq=False)
class ImageResiduals:
    """One image after the fit: predicted less measured pixels (n, 2) of its dots, in pixels.

    ``used`` (n,) says which dots were fitted: none of a check image. ``range_m`` and ``incidence_rad`` are of
    the board as seen from the camera (0: face on). ``sigma_px`` (n,) is each dot's stated sigma.
    """

    name: str
    camera: str
    purpose: Literal["camera", "mast", "check"]
    setup: str
    placement: str
    pan_rad: float | None
    tilt_rad: float | None
    rows: np.ndarray
    columns: np.ndarray
    pixels_px: FloatArray
    residuals_px: FloatArray
    sigma_px: FloatArray
    used: np.ndarray
    range_m: float
    incidence_rad: float


@dataclass(frozen=True, eq=False)
class StationResidual:
    """A prism or tape after the fit: measured less expected place (3,), metres, in the rover frame."""

    kind: Literal["prism", "tape"]
    setup: str
    placement: str
    point: str
    residual_m: FloatArray
    used: bool


@dataclass(frozen=True, eq=False)
class Degenerate:
    """A direction in which the survey says nothing: the unknowns that move together, and why, in words."""

    parameters: tuple[str, ...]
    sentence: str


@dataclass(frozen=True, eq=False)
class Calibration:
    """A fitted rig and everything that is needed to judge it.

    Attributes
    ----------
    method
        How it was fitted.
    mast_parameters
        4, 6 or 8.
    rig
        Mast and cameras; ``rig.fit`` and ``rig.provenance`` are empty.
    parameter_names
        (p,) of mast and cameras, as ``mast.translation_m.x`` and ``cameras.navcam_left.H.x``. A and O of a
        camera have two each (``A.1``, ``A.2``): radians along ``calib.camera.parameters.tangents``.
    estimate
        (p,) values; 0 for the two of an A or O, which count from the rig's own.
    covariance
        (p, p) of those.
    sigma
        Standard deviations under the mast file's keys: ``{"mast": {...}, "cameras": {name: {C: [3], ...}}}``.
    rms_px
        Camera to (x, y) rms of the fitted images' dots, pixels.
    check_rms_px
        Camera to (x, y) rms of the check images' dots and clicks, which were not fitted; without images whose
        board, as it is named, the camera cannot see.
    outliers
        What was left out.
    degenerate
        What the survey leaves open.
    notes
        What else a person should know, a sentence each.
    chi2, degrees_of_freedom
        Sum of squares of the residuals in stated sigmas, and what it is expected to be.
    chi2_probability
        The chance of a larger ``chi2`` were all sigmas right; nan where the method does not weigh by them.
    components
        How large the errors of each kind of measurement are, against its stated sigma; empty where the method
        does not weigh by them.
    wider, left_out_boards
        What further numbers would gain, the likeliest first, and what the rest says of each board; empty
        where the method does not weigh by sigmas.
    images, station
        What remains of every measurement.
    rover_from_station, rover_from_board
        By set-up, and by (set-up, placement).
    prisms_in_rover_m
        Refined where the CAD has a sigma.
    seconds
        How long it took.
    """

    method: Literal["paper", "joint"]
    mast_parameters: int
    rig: Rig
    parameter_names: tuple[str, ...]
    estimate: FloatArray
    covariance: FloatArray
    sigma: Mapping[str, Any]
    rms_px: Mapping[str, tuple[float, float]]
    check_rms_px: Mapping[str, tuple[float, float]]
    outliers: tuple[Outlier, ...]
    degenerate: tuple[Degenerate, ...]
    notes: tuple[str, ...]
    chi2: float
    degrees_of_freedom: float
    chi2_probability: float
    images: tuple[ImageResiduals, ...]
    station: tuple[StationResidual, ...]
    rover_from_station: Mapping[str, Rigid]
    rover_from_board: Mapping[tuple[str, str], Rigid]
    prisms_in_rover_m: Mapping[str, FloatArray]
    seconds: float
    components: tuple[Component, ...] = ()
    wider: tuple[WiderModel, ...] = ()
    left_out_boards: tuple[LeftOutBoard, ...] = ()

    def widened(self, kind: str) -> float:
        """Return by how much the fit takes a kind of measurement for worse than stated; 1 if it does not."""
        return next((c.weighed for c in self.components if c.kind == kind), 1.0)

    def part(self, prefix: str) -> np.ndarray:
        """Return where the parameters that begin with ``prefix`` are, as indices."""
        return np.array(
            [i for i, name in enumerate(self.parameter_names) if name.startswith(prefix)], dtype=int
        )
