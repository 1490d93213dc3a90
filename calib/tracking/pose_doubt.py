"""Whether pictures contradict the motion that a track was carried over: a pose wrong by more than it says.

A track is carried over a motion with the covariance that was told of it; the pictures after it tell where the
target is without that. How far the two lie apart, against the covariance of both, is chi-square. Once in a
thousand looks an honest motion is off by so much; below that nothing is said.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.camera.one_point import OnePoint
from calib.fit.significance import chance, sigmas
from calib.rigid import FloatArray

FALSE_ALARMS = 0.001
"""Chance that a look after an honest motion doubts it."""


@dataclass(frozen=True, eq=False)
class PoseDoubt:
    """What pictures say against a motion.

    Attributes
    ----------
    off_m
        (3,) where the pictures put the target less where the motion did, rover frame of now.
    sigmas
        How unlikely that is by chance, as a normal error's number of sigmas.
    sure
        Whether what was found is the track's target by the rules of a look; else it may be another thing.
    """

    off_m: FloatArray
    sigmas: float
    sure: bool = True

    @property
    def sentence(self) -> str:
        """It in words."""
        off = f"{100 * float(np.linalg.norm(self.off_m)):.1f} cm ({self.sigmas:.1f} sigma)"
        if self.sure:
            return (
                f"the pictures put the target {off} from where the pose does: the pose is wrong by more than "
                "its covariance says"
            )
        return (
            f"the pictures show what looks like the target {off} from where the pose puts it: the pose is "
            "wrong by more than its covariance says, or that is another thing"
        )


def pose_doubt(
    believed_m: FloatArray, covariance_m2: FloatArray, seen: OnePoint, sure: bool = True
) -> PoseDoubt | None:
    """Return what a seen place says against a believed one; None if it says nothing that chance does not.

    Parameters
    ----------
    believed_m, covariance_m2
        (3,) and (3, 3) of the target as the motion carried it.
    seen
        The target by the pictures alone.
    sure
        As `PoseDoubt.sure`.
    """
    off = seen.position_m - believed_m
    statistic = float(off @ np.linalg.solve(covariance_m2 + seen.covariance_m2, off))
    probability = chance(statistic, 3)
    return PoseDoubt(off, sigmas(probability), sure) if probability < FALSE_ALARMS else None
