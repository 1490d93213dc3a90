"""What the fit of a bench gives: the rig, how sure it is, which terms it needed, what was fixed by choice."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from calib.fit.bench_tests import Drift, OtherPlacements
from calib.fit.calibration import Degenerate, ImageResiduals, Outlier
from calib.fit.components import Component
from calib.fit.model_terms import ModelTerm
from calib.fit.significance import THREE_SIGMAS
from calib.mast.rig import Rig
from calib.rigid import FloatArray, Rigid


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
        (``calib.mast.covariance``); what was held is exact.
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
    drifts: tuple[Drift, ...]
    components: tuple[Component, ...]
    joint_rad: float
    inexact_m: float
    rover_from_board: Mapping[tuple[str, str], Rigid]
    bows_m: Mapping[str, FloatArray]
    seconds: float

    def part(self, prefix: str) -> np.ndarray:
        """Return where the parameters that begin with ``prefix`` are, as indices."""
        return np.array([i for i, n in enumerate(self.parameter_names) if n.startswith(prefix)], dtype=int)
