"""A proposed correction of a body pair's pose: what it is, how sure, and what was left out.

`calib.handoff.fit_body_pose` makes it, `calib.handoff.corrected_rig` applies it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from calib.fit.significance import THREE_SIGMAS
from calib.handoff.body_sights import BodySights
from calib.rigid import FloatArray, Rigid

PRIOR_SHIFT_M, PRIOR_TURN_RAD = 0.005, 0.005
"""Sigma an axis of how far two prism set-ups disagree: the paper's 5 mrad (2 mm at prisms 40 to 60 cm apart),
and what that and the 2 mm themselves do at a camera some 0.7 m from the prisms."""

WORDS = ("roll", "pitch", "yaw", "shift forward", "shift right", "shift down")
"""A step's six numbers: about and along the rover's x (forward), y (right), z (down)."""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """A hand-off that was not used: which, by how much (px), and the failed test.

    It contradicts the rest, by ``off_px`` in the worst eye; or, if it is not ``one_point``, its clicks
    contradict each other, by ``off_px`` across the epipolar line.
    """

    name: str
    off_px: float
    statistic: float
    limit: float
    one_point: bool = True

    @property
    def sentence(self) -> str:
        """The outlier in words."""
        if not self.one_point:
            return (
                f"{self.name} was not used: its two clicks do not mean one point, they are "
                f"{self.off_px:.1f} px apart across the epipolar line, {math.sqrt(self.statistic):.1f} sigma"
            )
        return f"{self.name} is off by {self.off_px:.1f} px after the correction and was not used"


@dataclass(frozen=True, eq=False)
class EyesApart:
    """What is left between the two eyes of a pair: mean of right less left, px, with covariance, in sigmas.

    One rigid motion cannot explain it: one eye moved by itself, or its model is off.
    """

    offset_px: FloatArray
    covariance_px2: FloatArray
    sigmas: float


@dataclass(frozen=True, eq=False)
class BodyPose:
    """A proposed correction of a body pair, and how sure it is.

    Attributes
    ----------
    cameras
        Which move.
    origin_m
        (3,) the middle of their centres before, rover frame: the turn is about it.
    step
        (6,) rotation vector, radians, and shift, metres, rover axes.
    covariance
        (6, 6) of the step, with the prior.
    gain
        (6, n, 2k): the step is the sum of gain times residual over the used hand-offs' pixels.
    motion
        The same motion of the cameras as a transform in the rover frame.
    used, outliers
        Names of the hand-offs that were, and those that were not.
    rms_px
        Camera to ((x, y) before, (x, y) after), over the used hand-offs.
    chi2_before, chi2_after, degrees_of_freedom
        Weighted sum of squares of what is found less what is predicted, and what it is expected to be after.
    scale
        ``chi2_after`` over its degrees of freedom where that is above 1: the covariance is widened by it.
    chance, sigmas
        Of hand-offs without any motion that look as moved as these, and the same in sigmas.
    seen
        How many of the six directions the hand-offs see.
    unseen
        A sentence for each that they do not see.
    eyes_apart
        For a pair that both found a target of.
    """

    cameras: tuple[str, ...]
    origin_m: FloatArray
    step: FloatArray
    covariance: FloatArray
    gain: FloatArray
    motion: Rigid
    used: BodySights
    outliers: tuple[LeftOut, ...]
    rms_px: dict[str, tuple[tuple[float, float], tuple[float, float]]]
    chi2_before: float
    chi2_after: float
    degrees_of_freedom: float
    scale: float
    chance: float
    sigmas: float
    seen: int
    unseen: tuple[str, ...]
    eyes_apart: EyesApart | None

    @property
    def significant(self) -> bool:
        """Whether chance alone does so less often than three sigma."""
        return self.chance < THREE_SIGMAS
