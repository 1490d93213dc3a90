"""Poses of the rover: which may follow which, and the motion between two."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.geometry.rigid import FloatArray, Rigid, quaternion_of
from mastctl.answers import PoseTold
from mastctl.errors import BadRequest, NotNow

STANDS_M, STANDS_RAD = 0.005, 0.001
"""Within these of each other two poses are one, stated twice: an odometer's noise, no motion."""

HELD_UP_S = 60.0
"""No pose is longer on its way. One that seems so was stamped by a clock that was set, or by another one."""


@dataclass(frozen=True, eq=False)
class RoverPose:
    """One pose of the rover.

    Attributes
    ----------
    covariance
        (6, 6) of the motion since the pose before: small rotation, rad², then translation, m², both along
        the rover's axes of this pose; None if it was not stated. `calib.matching.track.moved_track` has it
        so.
    time_s
        By the sender's clock, which need not be the daemon's; None if it was not stated.
    received_s
        When it came, seconds of CLOCK_MONOTONIC.
    """

    site_from_rover: Rigid
    covariance: FloatArray | None = None
    time_s: float | None = None
    received_s: float = 0.0

    def as_json(self, now_s: float) -> PoseTold:
        """Return it as JSON, with its age."""
        return {
            "position_m": self.site_from_rover.translation_m.tolist(),
            "quaternion": quaternion_of(self.site_from_rover.rotation),
            "time_s": self.time_s,
            "age_s": max(0.0, now_s - self.received_s),
        }


def check_follows(pose: RoverPose, before: RoverPose | None) -> None:
    """Pass a pose that is later than the one before it, or has another clock than that one.

    The sender's clock may be any, so no time of it is impossible, and none binds later poses for more than
    `HELD_UP_S`: a pose that is not later by it is refused while it may have been delayed on its way. Raises
    BadRequest ``pose_without_time``, NotNow ``pose_runs_backwards``.
    """
    if before is None or before.time_s is None:
        return
    passed_s = pose.received_s - before.received_s
    if pose.time_s is None:
        if passed_s > HELD_UP_S:
            return
        raise BadRequest(
            "pose_without_time",
            f"time_s is missing. The pose before had one ({before.time_s:g} s), and without it the "
            f"daemon cannot know which is later; {HELD_UP_S:g} s after that pose it may be left out",
        )
    if clock_was_set(pose, before) and before.time_s - pose.time_s + passed_s <= HELD_UP_S:
        raise NotNow(
            "pose_runs_backwards",
            f"time_s is {pose.time_s:g} s, which is not later than the pose before it ({before.time_s:g} s)",
        )


def clock_was_set(pose: RoverPose, before: RoverPose) -> bool:
    """Return whether a pose that follows another is not later than it by their times."""
    return pose.time_s is not None and before.time_s is not None and pose.time_s <= before.time_s


def motion_between(before: RoverPose, now: RoverPose) -> Rigid:
    """Return now_from_before: the rover frame of one pose in that of the other."""
    return now.site_from_rover.inverse @ before.site_from_rover


def stands(motion: Rigid) -> bool:
    """Return whether a motion is none."""
    turned_rad = math.acos(min(1.0, max(-1.0, (float(np.trace(motion.rotation)) - 1) / 2)))
    return float(np.linalg.norm(motion.translation_m)) <= STANDS_M and turned_rad <= STANDS_RAD
