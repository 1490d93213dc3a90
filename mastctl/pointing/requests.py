"""What the pointing loop is asked, what it answers, and how it is set."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from calib.pictures.patch_match import MatchSettings
from calib.pictures.shown_view import ViewLimits
from calib.rigid import FloatArray
from mastctl.devices.rest import DITHER_RAD
from mastctl.errors import MastctlError

Pair = tuple[float, float]


@dataclass(frozen=True)
class PixelTarget:
    """What a pixel of a named frame shows."""

    camera: str
    frame_id: str
    x_px: float
    y_px: float


@dataclass(frozen=True)
class PositionTarget:
    """A point (3,), metres, in the ``rover`` or ``site`` frame; the two are one before the first pose."""

    position_m: tuple[float, float, float]
    frame: str = "rover"


@dataclass(frozen=True)
class AnglesTarget:
    """Joint angles, radians."""

    pan_rad: float
    tilt_rad: float


@dataclass(frozen=True)
class Aim:
    """The pixel of a head camera on which the target is wanted."""

    camera: str
    x_px: float
    y_px: float


@dataclass(frozen=True)
class PointRequest:
    """Point at a target.

    Attributes
    ----------
    target
        Where to.
    aim
        Default: the image centre of the clicked camera if it is on the head, else of the left camera of
        the first stereo pair on the head.
    pointings
        1, or 2: measure the target again from where the first pointing led, and point once more.
    """

    target: PixelTarget | PositionTarget | AnglesTarget
    aim: Aim | None = None
    pointings: int = 1


@dataclass(frozen=True)
class Step:
    """One step of an operation, for the record: what it was, how it ended, when, and its numbers.

    ``detail`` holds plain values with units in their names; of a failed step also ``code`` and ``message``.
    """

    name: str
    state: Literal["done", "failed"]
    started_s: float
    duration_s: float
    detail: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Pointing:
    """One pointing and what was measured after it.

    Attributes
    ----------
    commanded_pan_rad, commanded_tilt_rad, measured_pan_rad, measured_tilt_rad
        Joint angles that were sent, and those measured at the new picture's mid-exposure.
    camera, frame_id
        The new picture: exposed after the head had settled.
    aim_px
        (x, y) where the target was wanted; None for joint angles.
    predicted_px
        (x, y) where target position, mast file and measured joint angles put it; None if out of view.
    target_px
        (x, y) where the picture shows it; None where nothing was clicked that could be looked for.
    residual_px, residual_sigma_px
        target_px - aim_px, and one sigma of the match; None as above.
    note
        One sentence that says why there is no residual; empty otherwise.
    motion_evidence
        By camera of the new pictures: whether they moved as the joints did, as a ``verdict`` with numbers.
    """

    commanded_pan_rad: float
    commanded_tilt_rad: float
    measured_pan_rad: float
    measured_tilt_rad: float
    camera: str
    frame_id: str
    aim_px: Pair | None
    predicted_px: Pair | None
    target_px: Pair | None
    residual_px: Pair | None
    residual_sigma_px: Pair | None
    note: str = ""
    motion_evidence: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class PointingResult:
    """What came of a request: position in the rover frame, range from the aim camera, the pointings.

    ``position_m`` and ``range_m`` are those of the last pointing, None for joint angles.
    """

    position_m: tuple[float, float, float] | None
    range_m: float | None
    pointings: tuple[Pointing, ...]


class PointingError(MastctlError):
    """The request failed; the mast was told to stop.

    Attributes
    ----------
    code
        For programs. Own codes: ``stopped``, ``unknown_camera``, ``wrong_camera``, ``bad_aim``,
        ``bad_request``, ``outside_image``, ``other_mast_file``, ``no_stereo``, ``head_fault``,
        ``head_moving``, ``bad_reading``, ``no_fresh_frame``, ``did_not_arrive``, ``did_not_settle``,
        ``not_in_view``, ``target_flat``, ``target_ambiguous``, ``target_border``, ``target_not_found``,
        ``target_moving``, ``eyes_disagree``. A code of a driver, of the limits or of the geometry passes
        through.
    step
        The step that failed.
    result
        The pointings done before it, None if there were none.
    """

    def __init__(self, code: str, message: str, step: str = "", result: PointingResult | None = None) -> None:
        self.code = code
        self.step = step
        self.result = result
        super().__init__(message)

    @property
    def detail(self) -> dict[str, str]:
        """The failed step, for the error's detail."""
        return {"step": self.step}


@dataclass(frozen=True)
class PointingSettings:
    """Times and tolerances of the loop, with the reasons for their values.

    Attributes
    ----------
    poll_s
        Between readings while the head moves.
    dwell_s
        How long the reading must stay the same: three exposures, and longer than a mast's ringing after the
        axis reports its position reached. A reading that dithers is watched for a second
        (`mastctl.devices.rest`).
    rest_tolerance_rad
        How far the readings of a head at rest may lie from each other: three counts of a 12-bit servo.
    arrival_tolerance_rad
        How far from the commanded angle a head may rest: three counts and half the backlash of a 12-bit
        servo, 6 mrad. What remains is measured in the picture.
    acceleration_s, margin_s
        Beyond distance over speed: ramps and an approach from one side; then everything else.
    reading_age_s
        Oldest reading that is one of now.
    jump_rad
        Beyond what the speed allows between two readings (twice over): two encoder slips of a degree.
    rest_wait_s
        How long a request waits for a head that still moves.
    frame_timeout_s
        For a new picture: some frames of a slow camera, on a busy machine.
    same_pose_rad
        Joint angles nearer than this are one pose: a tenth of a Pancam pixel.
    same_moment_s
        Exposures less apart than this are one: half a pixel would take 5000 px/s, which blurs any picture.
    between_eyes_px
        How far the target may move between the exposures of a pair that serves a measurement.
    nearest_m
        Nothing nearer is looked for.
    search_px, wide_search_px
        Half windows around the predicted place: what arrival tolerance and mast file explain in a Navcam
        (6 mrad are 8 px) with room; then what a slipped encoder may do (2 degrees are 45 px in a Navcam, 120
        in a Pancam).
    eyes_px, range_px
        Largest offset across the epipolar line, and along it after the move (same pair only), that is still
        put down to calibration: the paper's mast fit leaves 1.1 px rms.
    triangulation_sigma_px
        Of a pixel for the position's covariance: matching and calibration together.
    view
        What may lie between the view that joints tell and the one that a picture shows.
    match, small_half_px
        Of the matching itself; and the half patch that is tried where the usual one fits nowhere, because
        part of it lies on something nearer or farther.
    """

    poll_s: float = 0.02
    dwell_s: float = 0.15
    rest_tolerance_rad: float = DITHER_RAD
    arrival_tolerance_rad: float = 6e-3
    acceleration_s: float = 1.5
    margin_s: float = 2.5
    reading_age_s: float = 1.0
    jump_rad: float = 0.035
    rest_wait_s: float = 2.0
    frame_timeout_s: float = 8.0
    same_pose_rad: float = 3e-5
    same_moment_s: float = 1e-4
    between_eyes_px: float = 0.5
    nearest_m: float = 0.4
    search_px: float = 48.0
    wide_search_px: float = 200.0
    eyes_px: float = 2.0
    range_px: float = 4.0
    triangulation_sigma_px: float = 0.2
    small_half_px: int = 12
    view: ViewLimits = field(default_factory=ViewLimits)
    match: MatchSettings = field(default_factory=MatchSettings)


def pair(values: FloatArray) -> Pair:
    """Return (2,) as plain floats."""
    return float(values[0]), float(values[1])


def triple(values: FloatArray) -> tuple[float, float, float]:
    """Return (3,) as plain floats."""
    return float(values[0]), float(values[1]), float(values[2])


def rounded(values: FloatArray | Pair, digits: int = 4) -> list[float]:
    """Return numbers for a step's detail."""
    return [round(float(value), digits) for value in np.asarray(values).ravel()]
