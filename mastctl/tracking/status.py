"""What is known about the track at one moment: frozen, made anew at each change."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from calib.rigid import FloatArray
from mastctl.as_json import as_json, picked
from mastctl.tracking.look import Sighting
from mastctl.tracking.pose import RoverPose, motion_between

TrackState = Literal["idle", "starting", "tracking", "lost", "stopped"]
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
    state, reason
        The word, and one sentence that says why; empty where nothing needs to be said.
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
        The last look.
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
    seen: Sighting | None = None
    found_by: str = ""
    looks: int = 0
    misses: int = 0
    handoffs: tuple[HandedOver, ...] = ()
    renewals: int = 0
    operation: str | None = None
    changed_s: float = 0.0

    def told(self, now_s: float) -> dict[str, Any]:
        """Return it as ``GET /track`` tells it."""
        position, covariance = self.position_m, self.covariance_m2
        in_site = position
        if position is not None and self.pose and self.stands_at:
            in_site = self.stands_at.site_from_rover.points(position)
            moved = motion_between(self.stands_at, self.pose)
            position = moved.points(position)
            if covariance is not None:
                covariance = moved.rotation @ covariance @ moved.rotation.T
        nothing = {"pixels": {}, "renewed": False, "pose_doubt": ""} if self.seen is None else {}
        return {
            **picked(self, "sequence", "state", "reason", "id", "predicted", "operation"),
            **picked(self, "looks", "misses", "handoffs", "renewals"),
            **picked(self.seen, "range_m", "pair", "pixels", "chi2", "renewed", "pose_doubt"),
            **nothing,
            "position_m": as_json(position),
            "position_in_site_m": as_json(in_site),
            "covariance_m2": as_json(covariance),
            "pose": None if self.pose is None else self.pose.told(now_s),
            "age_s": max(0.0, now_s - self.changed_s),
        }
