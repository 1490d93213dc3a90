"""A track between two looks: what is carried from pose to pose, and its status."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.geometry.rigid import FloatArray, carried_covariance
from calib.matching.track import Track, moved_track
from mastctl.answers import TrackStands, TrackState
from mastctl.as_json import as_json
from mastctl.motion.poses import RoverPose, motion_between
from mastctl.motion.search import TrackSighting


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
        """Return the track carried to a pose, or left where it is if the pose jumped, with the reason.

        A pose that jumped is not forgotten: what its motion was uncertain by is part of the next one.
        ``origin_m`` is (3,), from where the target's range counts, rover frame; ``most_step`` the longest
        way, as a part of that range.
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
            # Whatever is found after this must be confirmed by both cameras.
            return replace(self, track=replace(self.track, state="lost"), owed=(covariance, pose)), (
                f"the pose jumped by {way_m:.2f} m with the target {range_m:.2f} m away; a track is carried "
                f"over at most {most_step:g} of the range at a time"
            )
        return Carried(moved_track(self.track, motion, covariance), pose), ""


ACTIVE: frozenset[TrackState] = frozenset({"starting", "tracking", "lost"})


@dataclass(frozen=True)
class HandedOver:
    """The target went from one pair to another, at a range of the new one."""

    from_pair: str
    to_pair: str
    range_m: float


@dataclass(frozen=True, eq=False)
class TrackStatus:
    """The track at one moment.

    Attributes
    ----------
    sequence
        Grows with each change.
    reason
        One sentence says why; empty where nothing needs to be said.
    id
        The operation that started the track.
    predicted
        Whether the rover moved since the last look: the position is carried over, not seen.
    position_m, covariance_m2
        (3,) and (3, 3) in the rover frame of ``stands_at``; no covariance is known after a pose that jumped.
    stands_at
        The pose that the track was carried to; None before the first pose.
    pose
        The newest pose. It is another than ``stands_at`` after a pose that jumped, and while a look runs.
    seen
        What the last look saw.
    found_by
        The pair that found the target last.
    looks, misses
        Looks so far, and how many in a row did not find it.
    handoffs, renewals
        Changes of the pair; how often the key picture was renewed.
    operation
        The running start or look.
    changed_s
        When this became so, seconds of CLOCK_MONOTONIC.
    """

    sequence: int = 0
    state: TrackState = "idle"
    reason: str = ""
    id: str | None = None
    predicted: bool = False
    position_m: FloatArray | None = None
    covariance_m2: FloatArray | None = None
    stands_at: RoverPose | None = None
    pose: RoverPose | None = None
    seen: TrackSighting | None = None
    found_by: str = ""
    looks: int = 0
    misses: int = 0
    handoffs: tuple[HandedOver, ...] = ()
    renewals: int = 0
    operation: str | None = None
    changed_s: float = 0.0

    def as_json(self, now_s: float) -> TrackStands:
        """Return it as ``GET /track`` has it."""
        position, covariance = self.position_m, self.covariance_m2
        in_site = position
        if position is not None and self.pose and self.stands_at:
            in_site = self.stands_at.site_from_rover.points(position)
            moved = motion_between(self.stands_at, self.pose)
            position = moved.points(position)
            if covariance is not None:
                covariance = moved.rotation @ covariance @ moved.rotation.T
        seen = self.seen
        return {
            "sequence": self.sequence,
            "state": self.state,
            "reason": self.reason,
            "id": self.id,
            "predicted": self.predicted,
            "operation": self.operation,
            "looks": self.looks,
            "misses": self.misses,
            "handoffs": as_json(self.handoffs),
            "renewals": self.renewals,
            "range_m": None if seen is None else as_json(seen.range_m),
            "pair": None if seen is None else seen.pair,
            "pixels": {} if seen is None else as_json(seen.pixels),
            "chi2": None if seen is None else as_json(seen.chi2),
            "renewed": False if seen is None else seen.renewed,
            "pose_doubt": "" if seen is None else seen.pose_doubt,
            "position_m": as_json(position),
            "position_in_site_m": as_json(in_site),
            "covariance_m2": as_json(covariance),
            "pose": None if self.pose is None else self.pose.as_json(now_s),
            "age_s": max(0.0, now_s - self.changed_s),
        }
