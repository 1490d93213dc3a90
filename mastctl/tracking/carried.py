"""A track and the pose that it stands at: carried over from pose to pose, unless a pose jumps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.rigid import FloatArray, carried_covariance
from calib.tracking.track import Track, moved_track
from mastctl.tracking.pose import RoverPose, motion_between


@dataclass(frozen=True, eq=False)
class Carried:
    """A track between two looks. Immutable.

    Attributes
    ----------
    track
        In the rover frame of ``stands_at``.
    stands_at
        None as long as no pose is known.
    owed
        Covariance (6, 6) of the motions since then, and the pose up to which they go; None without any.
    """

    track: Track
    stands_at: RoverPose | None
    owed: tuple[FloatArray, RoverPose] | None = None

    @property
    def jumped(self) -> bool:
        """Whether poses came since that the track was not carried to."""
        return self.owed is not None

    def to(self, pose: RoverPose, origin_m: FloatArray, most_step: float) -> tuple[Carried, str]:
        """Return the track carried to a pose, or left where it stands if the pose jumped, with the reason.

        A pose that jumped is not forgotten: what its motion was uncertain by is part of the next one.

        Parameters
        ----------
        pose
            With its covariance.
        origin_m
            (3,) from where the target's range counts, rover frame.
        most_step
            Longest way, as a part of that range.
        """
        stood, covariance = self.stands_at, pose.covariance
        assert stood is not None and covariance is not None
        if self.owed is not None:
            before, at = self.owed
            covariance = covariance + carried_covariance(before, motion_between(at, pose))
        motion = motion_between(stood, pose)
        range_m = float(np.linalg.norm(self.track.position_m - origin_m))
        way_m = float(np.linalg.norm(motion.translation_m))
        if way_m > most_step * range_m:
            # Whatever is found after this must be confirmed by both eyes.
            return replace(self, track=replace(self.track, state="lost"), owed=(covariance, pose)), (
                f"the pose jumped by {way_m:.2f} m with the target {range_m:.2f} m away; a track is carried "
                f"over at most {most_step:g} of the range at a time"
            )
        return Carried(moved_track(self.track, motion, covariance), pose), ""
