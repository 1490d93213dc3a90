"""The result of a calibration: the rig, its uncertainty, measurements left out, and residuals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from calib.adjust.gross import Outlier
from calib.adjust.hypotheses import Finding
from calib.adjust.model_terms import TermGain
from calib.adjust.noise import Component
from calib.adjust.terms import StationTerm
from calib.adjust.unknowns import Estimate
from calib.geometry.rig import Rig, RigCamera
from calib.geometry.rigid import FloatArray, Rigid
from calib.survey.records import Click, Survey

HELD_FIXED = (
    "R0 of every camera is fixed at 0: whatever it does, A, H and V do as well",
    "an offset of pan is no parameter: it is the mast's rotation z",
    "an offset of tilt is no parameter: it turns all head cameras together, which their own axes do as well",
)
"""Parameters that no survey can separate from others, and which of those stands for them."""


@dataclass(frozen=True, eq=False)
class ImageResiduals:
    """One image after the fit: predicted less measured pixels (n, 2) of its dots, in pixels.

    ``used`` (n,) says which dots were fitted: none of a check image. ``range_m`` and ``incidence_rad`` are of
    the board as seen from the camera (0: face on). ``sigma_px`` (n,) is each dot's stated sigma,
    ``scatter`` what it counts times in this image beside what it does in all of the camera.
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
    scatter: float = 1.0


@dataclass(frozen=True, eq=False)
class Degenerate:
    """A direction in which the survey says nothing: the unknowns that move together, and why."""

    parameters: tuple[str, ...]
    sentence: str


class CheckExpected(NamedTuple):
    """What a camera's check images are off by, rms per axis, pixels; what they should be, and the most that
    chance allows; and the chance of more than they are."""

    seen_px: float
    expected_px: float
    most_px: float
    chance: float


@dataclass(frozen=True, eq=False, kw_only=True)
class FittedRig:
    """A fitted rig and what is needed to judge it, whatever it was fitted to.

    ``parameter_names`` (p,) and ``covariance`` (p, p) are of what was fitted of the mast, the joints and the
    cameras, as ``mast.translation_m.x`` and ``cameras.navcam_left.H.x`` (``calib.geometry.covariance``); what
    was fixed is exact. A and O of a camera have two each (``A.1``, ``A.2``): radians along
    ``calib.geometry.rigid.tangents``. ``sigma`` are standard deviations under the mast file's keys:
    ``{"mast": {...}, "cameras": {name: {C: [3], ...}}}``. ``rms_px`` and ``check_rms_px`` are by camera the
    (x, y) rms of what was fitted in images, and of check images, which were not; without images whose board,
    as it is named, the camera cannot see. ``chi2`` is the sum of squares of the residuals in stated sigmas,
    ``degrees_of_freedom`` what it is expected to be, ``chi2_probability`` the chance of a larger one were all
    sigmas right; nan where the method does not weigh by them. ``components`` are how large the errors of each
    kind of measurement are against its stated sigma, ``contradictions`` each placement tested against the
    others, the least likely first; both are empty where the method does not weigh. The covariance is by what
    the sigmas were found to be. ``rover_from_board`` is by set-up, or board, and placement.
    """

    rig: Rig
    parameter_names: tuple[str, ...]
    covariance: FloatArray
    sigma: Mapping[str, Any]
    rms_px: Mapping[str, tuple[float, float]]
    check_rms_px: Mapping[str, tuple[float, float]]
    images: tuple[ImageResiduals, ...]
    outliers: tuple[Outlier, ...]
    degenerate: tuple[Degenerate, ...]
    notes: tuple[str, ...]
    chi2: float
    degrees_of_freedom: float
    chi2_probability: float
    components: tuple[Component, ...] = ()
    checks: Mapping[str, CheckExpected]
    rover_from_board: Mapping[tuple[str, str], Rigid]
    contradictions: tuple[Finding, ...] = ()
    seconds: float

    def part(self, prefix: str) -> np.ndarray:
        """Return where the parameters that begin with ``prefix`` are, as indices."""
        return np.array([i for i, n in enumerate(self.parameter_names) if n.startswith(prefix)], dtype=int)


@dataclass(frozen=True, eq=False, kw_only=True)
class Calibration(FittedRig):
    """A rig fitted to a survey.

    ``station`` are prisms and tapes, and their measured less expected places (3,), metres, in the rover
    frame. ``estimate`` (p,) are the values of the parameters; 0 for the two of an A or O, which count from
    the rig's own. ``wider`` is the gain of further numbers, the likeliest first; empty where the method does
    not weigh. ``prisms_in_rover_m`` are refined where the CAD has a sigma. ``unseen_clicks`` are check clicks
    on points that their camera, as fitted, cannot see.
    """

    method: Literal["paper", "joint"]
    mast_parameters: int
    estimate: FloatArray
    station: tuple[tuple[StationTerm, FloatArray], ...]
    rover_from_station: Mapping[str, Rigid]
    prisms_in_rover_m: Mapping[str, FloatArray]
    wider: tuple[Finding, ...] = ()
    unseen_clicks: tuple[Click, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class BenchCalibration(FittedRig):
    """A rig fitted to pictures of boards that stood anywhere.

    ``gauges`` are quantities that pictures cannot determine, and how they were fixed, a sentence each.
    ``drifts`` say how far each joint and each camera drifts, the least likely first. ``joint_rad`` is the
    error of one joint reading, besides its joint's errors, ``inexact_m`` how far corners are printed beside
    their places, as all pictures show it alike (0 if none do), ``bows_m`` by board its bow (across, down),
    metres.
    """

    terms: tuple[TermGain, ...]
    gauges: tuple[str, ...]
    drifts: tuple[Finding, ...]
    joint_rad: float
    inexact_m: float
    bows_m: Mapping[str, FloatArray]


def rig_of(survey: Survey, state: Estimate) -> Rig:
    """Return the rig of a state; it has the survey folder's name."""
    cameras = {
        n: RigCamera(survey.cameras[n].on, m, survey.cameras[n].sensor_mode) for n, m in state.cameras.items()
    }
    stereo = {p: pair for p, pair in survey.stereo.items() if set(pair) <= set(cameras)}
    name = survey.folder.name or "calibrated"
    return Rig(name, state.as_mast, cameras, stereo, joints=state.as_joints)
