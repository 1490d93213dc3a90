"""A track: the poses that it is carried over, its status, and what a start, a look or a pose makes of it."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib.geometry.rigid import FloatArray, Rigid, carried_covariance, quaternion_of
from calib.matching.track import Track, moved_track
from mastctl.answers import PoseTold, TrackStands, TrackState
from mastctl.as_json import as_json
from mastctl.control.records import Operation
from mastctl.errors import BadRequest, NotNow
from mastctl.motion.target_look import TrackSighting

STANDS_M, STANDS_RAD = 0.005, 0.001
"""Within these of each other two poses are one standing, told twice: an odometer's noise, no motion."""

HELD_UP_S = 60.0
"""No pose is longer on its way. One that seems so was stamped by a clock that was set, or by another one."""


@dataclass(frozen=True, eq=False)
class RoverPose:
    """One pose of the rover.

    Attributes
    ----------
    site_from_rover
        The pose.
    covariance
        (6, 6) of the motion since the pose before: small rotation, rad², then translation, m², both along
        the rover's axes of this pose; None if it was not said. `calib.matching.track.moved_track` takes it
        so.
    time_s
        By the sender's clock, which need not be the daemon's; None if it was not said.
    received_s
        When it came, seconds of CLOCK_MONOTONIC.
    """

    site_from_rover: Rigid
    covariance: FloatArray | None = None
    time_s: float | None = None
    received_s: float = 0.0

    def told(self, now_s: float) -> PoseTold:
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
    `HELD_UP_S`: a pose that is not later by it is refused while it may have been held up on its way.

    Raises
    ------
    BadRequest
        ``pose_without_time``.
    NotNow
        ``pose_runs_backwards``.
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
    seen: TrackSighting | None = None
    found_by: str = ""
    looks: int = 0
    misses: int = 0
    handoffs: tuple[HandedOver, ...] = ()
    renewals: int = 0
    operation: str | None = None
    changed_s: float = 0.0

    def told(self, now_s: float) -> TrackStands:
        """Return it as ``GET /track`` tells it."""
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
            "pose": None if self.pose is None else self.pose.told(now_s),
            "age_s": max(0.0, now_s - self.changed_s),
        }


LookOutcome = tuple[Track, TrackSighting]
Said = tuple[Any, ...]
"""Something for the log: level, words, what they are about."""


@dataclass(frozen=True, eq=False)
class TrackTurn:
    """What is known after something came: the status, what is followed (or None), what to log."""

    status: TrackStatus
    carried: Carried | None
    said: tuple[Said, ...] = ()


def started(status: TrackStatus, operation: Operation, outcome: LookOutcome | None, left: bool) -> TrackTurn:
    """Return a track that began, or why it did not.

    Parameters
    ----------
    status
        That of its start.
    operation, outcome
        The operation that looked first, at its end, and what it saw; None if it failed.
    left
        Whether the rover moved meanwhile.
    """
    if outcome is None or left:
        reason = "the rover moved while the track's first pictures were taken; start it again"
        if outcome is None:
            reason = _why(operation)
        ended: TrackState = "stopped" if operation.state == "stopped" else "idle"
        return TrackTurn(TrackStatus(state=ended, reason=reason, id=status.id, pose=status.pose), None)
    track, seen = outcome
    said = (logging.INFO, "track %s begins %.2f m away, by %s", status.id, seen.range_m, seen.pair)
    status = replace(
        status,
        state="tracking",
        position_m=seen.position_m,
        covariance_m2=seen.covariance_m2,
        seen=seen,
        found_by=seen.pair,
    )
    return TrackTurn(status, Carried(track, status.stands_at), (said,))


def looked(
    status: TrackStatus, carried: Carried, operation: Operation, outcome: LookOutcome | None
) -> TrackTurn:
    """Return what a look told, which stood where the track was carried to; parameters as for `started`."""
    status = replace(status, looks=status.looks + 1)
    if outcome is None and operation.state == "stopped":
        return TrackTurn(replace(status, state="stopped", reason=_why(operation)), None)
    if outcome is None:
        # Nothing was seen: both eyes must find the target again, as after a look without success.
        track = replace(carried.track, state="lost", misses=carried.track.misses + 1)
        lost = replace(status, state="lost", reason=_why(operation), misses=track.misses)
        return TrackTurn(lost, replace(carried, track=track))
    track, seen = outcome
    carried = replace(carried, track=track)
    said: list[Said] = []
    if seen.pose_doubt and seen.state == "tracked":  # what is lost is logged with its whole reason
        said.append((logging.WARNING, "track %s: %s", status.id, seen.pose_doubt))
    status = replace(
        status,
        reason="; ".join(filter(None, (seen.reason, seen.pose_doubt))),
        position_m=seen.position_m,
        covariance_m2=seen.covariance_m2,
        seen=seen,
        misses=track.misses,
        renewals=status.renewals + seen.renewed,
    )
    if seen.state == "lost":
        return TrackTurn(replace(status, state="lost"), carried, tuple(said))
    if seen.pair != status.found_by:
        said.append((logging.INFO, "track %s: %s hands over to %s", status.id, status.found_by, seen.pair))
        handed = HandedOver(status.found_by, seen.pair, seen.range_m)
        status = replace(status, handoffs=(*status.handoffs, handed))
    status = replace(status, state="tracking", predicted=False, found_by=seen.pair)
    return TrackTurn(status, carried, tuple(said))


def moved_on(
    status: TrackStatus, carried: Carried, pose: RoverPose, origin_m: FloatArray, most_step: float
) -> TrackTurn:
    """Return a track carried over to a pose, or lost because the pose jumped.

    ``origin_m`` and ``most_step`` as in `mastctl.motion.track.Carried.to`.
    """
    after_jump = carried.jumped
    carried, reason = carried.to(pose, origin_m, most_step)
    if reason:
        return TrackTurn(replace(status, state="lost", reason=reason, covariance_m2=None), carried)
    if after_jump:
        status = replace(status, reason="not looked for since a pose jumped")
    track = carried.track
    status = replace(
        status, position_m=track.position_m, covariance_m2=track.target_covariance_m2, stands_at=pose
    )
    return TrackTurn(status, carried)


def _why(operation: Operation) -> str:
    """Why an operation brought nothing, in its own words."""
    return str((operation.error or {}).get("message", "the operation ended without a result"))
