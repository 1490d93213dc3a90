"""How pointing and tracking are set: times and tolerances, with the reasons for their values."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated

from pydantic import Field

from calib.files.records import ABSENT, PathInFile, Record
from calib.matching.patch import MatchSettings
from mastctl.devices.joint_history import DITHER_RAD


@dataclass(frozen=True)
class PointingSettings:
    """Times and tolerances of the loop, with the reasons for their values."""

    poll_s: float = 0.02  # between readings while the head moves
    dwell_s: float = 0.15
    """How long the reading must stay the same: three exposures, and longer than a mast's ringing after the
    axis reports its position reached. A reading that dithers is watched for a second."""
    rest_tolerance_rad: float = DITHER_RAD
    """How far the readings of a head at rest may lie from each other: three counts of a 12-bit servo."""
    arrival_tolerance_rad: float = 6e-3
    """How far from the commanded angle a head may rest: three counts and half the backlash of a 12-bit
    servo. What remains is measured in the image."""
    acceleration_s: float = 1.5  # beyond distance over speed: ramps, and an approach from one side
    margin_s: float = 2.5  # everything else
    jump_rad: float = 0.035  # beyond what twice the speed allows between readings: two slips of a degree
    rest_wait_s: float = 2.0  # how long a request waits for a head that still moves
    frame_timeout_s: float = 8.0  # for a new image: some frames of a slow camera, on a busy machine
    repeat_after_s: float = 1.0
    """How much later a second image is taken, which has to repeat a residual before it is reported; 0: none.
    So an image older than its stamp by up to that is found out: the residual was measured in one that was
    exposed by a head at rest."""
    same_pose_rad: float = 3e-5  # joint angles nearer than this are one pose: a tenth of a Pancam pixel
    same_moment_s: float = 1e-4
    """Exposures less apart than this are one: half a pixel would take 5000 px/s, which blurs any image."""
    between_cameras_px: float = 0.5  # how far the target may move between exposures that serve a measurement
    nearest_m: float = 0.4  # nothing nearer is searched
    unknown_nearest_m: float = 1.0
    """A thing of unknown range is assumed at this or farther, in 95 of 100: nearer than a mast's camera has
    the ground only looking straight down."""
    search_px: float = 48.0
    """Half window around the predicted place: what arrival tolerance and mast file explain in a Navcam
    (6 mrad are 8 px) with room."""
    wide_search_px: float = 200.0
    """The next: what a slipped encoder may do (2 degrees are 45 px in a Navcam, 120 in a Pancam)."""
    across_px: float = 2.0
    """Largest offset across the epipolar line that is still put down to calibration: the paper's mast fit
    leaves 1.1 px rms."""
    range_px: float = 4.0  # the same along it after the move, of the same pair only
    triangulation_sigma_px: float = 0.2
    """Of a pixel for the position's covariance: noise and calibration. What the match in the other camera
    shows is added, so that a position on rough ground is reported as less sure."""
    small_half_px: int = 12  # half patch that is tried after a move where the usual one fits nowhere
    match: MatchSettings = field(
        default_factory=partial(MatchSettings, roughness=0.02, relief=0.01, least_lead=0.03)
    )
    """``roughness`` and ``relief`` decide sigmas only, and only where no second camera saw the surface. A
    second place may fit a little better than elsewhere, as along a rock's smooth edge: the prediction and the
    other camera must confirm the best."""


class PairBounds(Record):
    """For which targets a pair serves; its range is that from the middle between its cameras."""

    nearest_m: Annotated[float, Field(ge=0.0, le=1000.0)] = Field(
        default=0.0, description="least range of the target"
    )
    steepest_rad: Annotated[float, Field(ge=0.0, le=math.pi / 2)] = Field(
        default=math.pi / 2, description="how far below the horizontal it looks at most"
    )


USUAL_BOUNDS = {"pancam": PairBounds(nearest_m=6.0), "navcam": PairBounds(nearest_m=2.0)}
"""The paper's ranges, of pairs that no configuration names."""


class HandoffRules(Record):
    """What decides between the pairs; at a range error of 0.2 a 640x480 Hazcam serves up to some 6 m."""

    pairs: dict[str, PairBounds] = Field(default={}, description="the pair for each range (Tracking)")
    margin_px: Annotated[float, Field(ge=0.0, le=1000.0)] = Field(
        default=30.0, description="the target lies so far inside both pictures"
    )
    disparity_error_px: Annotated[float, Field(ge=0.001, le=100.0)] = Field(
        default=1.0, description="of the paper's eq. (1)"
    )
    range_error: Annotated[float, Field(ge=0.001, le=10.0)] = Field(
        default=0.2, description="largest range error that a pair may have"
    )

    def bounds(self, pair: str) -> PairBounds:
        """Return for which targets a pair serves."""
        return self.pairs.get(pair) or USUAL_BOUNDS.get(pair, PairBounds())


class TrackingSettings(Record):
    """What may be set about tracking.

    A tenth of the range is a usual step between two poses; with three tenths the target is seen so
    differently that a longer step is treated as a pose that jumped.
    """

    handoff: HandoffRules = HandoffRules()
    most_step: Annotated[float, Field(ge=0.01, le=1.0)] = Field(
        default=0.3, description="longest way between two poses"
    )
    start_error: Annotated[float, Field(ge=0.001, le=1.0)] = Field(
        default=0.1, description="greatest distance of the target from a given position"
    )
    handoff_log: PathInFile = Field(default=ABSENT, description="record of hand-offs")
