"""What a calibration gives: the rig, how sure it is, what was left out and what remains unexplained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from calib.adjust.drifts import BenchDrift, OtherPlacements
from calib.adjust.goodness import Component
from calib.adjust.left_out import LeftOutBoard
from calib.adjust.model_terms import ModelTerm
from calib.adjust.outliers import Outlier
from calib.adjust.significance import THREE_SIGMAS
from calib.adjust.wider import WiderModel
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, Rigid

HELD_FIXED = (
    "R0 of every camera is held at 0: whatever it does, A, H and V do as well",
    "an offset of pan is no parameter: it is the mast's rotation z",
    "an offset of tilt is no parameter: it turns all head cameras together, which their own axes do as well",
)
"""What no survey of any kind can tell from other parameters, and which of them stands for it."""


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
        camera have two each (``A.1``, ``A.2``): radians along ``calib.geometry.parameters.tangents``.
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


@dataclass(frozen=True, eq=False)
class TermGain:
    """A part of the model that enters if the pictures ask for it, or cannot exclude one that would matter.

    Attributes
    ----------
    term
        What it is; its name is ``pan harmonic 1``, ``tilt backlash``, ``axis offset``, ``bow of b1``.
    entered
        Whether it is part of the model.
    values
        What the fit with it says its parameters are (k,), in the units of their names.
    sigma
        (k,) of these.
    chi2
        By how much the weighted sum of squares is lower with it than without it.
    chance
        Of so large a gain were it nothing.
    moves_px
        Rms over all corners of what it moves pixels by; nan where it did not enter.
    """

    term: ModelTerm
    entered: bool
    values: FloatArray
    sigma: FloatArray
    chi2: float
    chance: float
    moves_px: float

    @property
    def name(self) -> str:
        """What a person calls the term."""
        return self.term.name

    @property
    def parameters(self) -> tuple[str, ...]:
        """Its numbers' names (k,)."""
        return self.term.parameters

    @property
    def sentence(self) -> str:
        """The term in words."""
        size = float(np.linalg.norm(self.values))
        spread = float(np.sqrt(np.mean(self.sigma**2)))
        milli = "mm" if self.term.kind in ("offset", "bow") else "mrad"
        told = f"{self.name}: {1e3 * size:.2f} ± {1e3 * spread:.2f} {milli}"
        if not self.entered:
            return f"{told}, not significant (chi-square {self.chi2:.1f}): left out"
        if self.chance > THREE_SIGMAS and self.term.kind != "harmonic 2":
            return f"{told}, chi-square {self.chi2:.1f}: not significant, but the pictures cannot exclude it"
        return f"{told}, moves pixels by {self.moves_px:.2f} px rms, lowers chi-square by {self.chi2:.0f}"


class CheckExpected(NamedTuple):
    """What a camera's check images should be off by, rms per axis, pixels: expected, and the most that chance
    allows; and the chance of more than they are."""

    rms_px: float
    most_px: float
    chance: float


@dataclass(frozen=True, eq=False)
class BenchCalibration:
    """A rig fitted to pictures of boards that stood anywhere.

    Attributes
    ----------
    rig
        Cameras, mast and joints; ``rig.fit`` and ``rig.provenance`` are empty.
    parameter_names, covariance
        (p,) and (p, p) of the mast's, the joints' and the cameras' parameters that were fitted
        (``calib.geometry.covariance``); what was held is exact.
    terms
        Every term that could have entered.
    rms_px, check_rms_px
        Camera to (x, y) rms of the corners that were fitted, and of those of check images.
    checks
        Camera to what check images should be off by, and how likely it is that they are off by more.
    images
        What remains of every image.
    outliers
        What was left out, each with its reason.
    degenerate
        What the pictures leave open.
    gauges, notes
        What pictures cannot know and how it was fixed; what else a person should know. Sentences.
    chi2, degrees_of_freedom, chi2_probability
        Weighted sum of squares, what it is expected to be, and the chance of a larger one, by stated sigmas.
    placements
        Each placement held against the others, the least likely first.
    drifts
        How far each joint and each camera drifts, the least likely first.
    components
        How large errors were against what was stated; the covariance is by what they were.
    joint_rad
        What one joint reading is off by, besides its joint's errors.
    inexact_m
        What corners are off by on the board beyond their own sigmas; 0 where these explain them.
    rover_from_board, bows_m
        Poses by board and placement; by board its bow (across, down), metres.
    seconds
        How long it took.
    """

    rig: Rig
    parameter_names: tuple[str, ...]
    covariance: FloatArray
    sigma: Mapping[str, Any]
    terms: tuple[TermGain, ...]
    rms_px: Mapping[str, tuple[float, float]]
    check_rms_px: Mapping[str, tuple[float, float]]
    checks: Mapping[str, CheckExpected]
    images: tuple[ImageResiduals, ...]
    outliers: tuple[Outlier, ...]
    degenerate: tuple[Degenerate, ...]
    gauges: tuple[str, ...]
    notes: tuple[str, ...]
    chi2: float
    degrees_of_freedom: float
    chi2_probability: float
    placements: tuple[OtherPlacements, ...]
    drifts: tuple[BenchDrift, ...]
    components: tuple[Component, ...]
    joint_rad: float
    inexact_m: float
    rover_from_board: Mapping[tuple[str, str], Rigid]
    bows_m: Mapping[str, FloatArray]
    seconds: float

    def part(self, prefix: str) -> np.ndarray:
        """Return where the parameters that begin with ``prefix`` are, as indices."""
        return np.array([i for i, n in enumerate(self.parameter_names) if n.startswith(prefix)], dtype=int)
