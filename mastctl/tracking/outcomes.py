"""What a look, a start or a pose makes of a track: the next status from the one before, and nothing else."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any

from calib.rigid import FloatArray
from calib.tracking.track import Track
from mastctl.operations.records import Operation
from mastctl.tracking.carried import Carried
from mastctl.tracking.look import Sighting
from mastctl.tracking.pose import RoverPose
from mastctl.tracking.status import HandedOver, TrackState, TrackStatus

Outcome = tuple[Track, Sighting]
Said = tuple[Any, ...]
"""Something for the log: level, words, what they are about."""


@dataclass(frozen=True, eq=False)
class Turn:
    """What is known after something came: the status, what is followed (or None), what to log."""

    status: TrackStatus
    carried: Carried | None
    said: tuple[Said, ...] = ()


def started(status: TrackStatus, operation: Operation, outcome: Outcome | None, left: bool) -> Turn:
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
        return Turn(TrackStatus(state=ended, reason=reason, id=status.id, pose=status.pose), None)
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
    return Turn(status, Carried(track, status.stands_at), (said,))


def looked(status: TrackStatus, carried: Carried, operation: Operation, outcome: Outcome | None) -> Turn:
    """Return what a look told, which stood where the track was carried to; parameters as for `started`."""
    status = replace(status, looks=status.looks + 1)
    if outcome is None and operation.state == "stopped":
        return Turn(replace(status, state="stopped", reason=_why(operation)), None)
    if outcome is None:
        # Nothing was seen: both eyes must find the target again, as after a look without success.
        track = replace(carried.track, state="lost", misses=carried.track.misses + 1)
        lost = replace(status, state="lost", reason=_why(operation), misses=track.misses)
        return Turn(lost, replace(carried, track=track))
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
        return Turn(replace(status, state="lost"), carried, tuple(said))
    if seen.pair != status.found_by:
        said.append((logging.INFO, "track %s: %s hands over to %s", status.id, status.found_by, seen.pair))
        handed = HandedOver(status.found_by, seen.pair, seen.range_m)
        status = replace(status, handoffs=(*status.handoffs, handed))
    status = replace(status, state="tracking", predicted=False, found_by=seen.pair)
    return Turn(status, carried, tuple(said))


def moved_on(
    status: TrackStatus, carried: Carried, pose: RoverPose, origin_m: FloatArray, most_step: float
) -> Turn:
    """Return a track carried over to a pose, or lost because the pose jumped.

    ``origin_m`` and ``most_step`` as in `mastctl.tracking.carried.Carried.to`.
    """
    after_jump = carried.jumped
    carried, reason = carried.to(pose, origin_m, most_step)
    if reason:
        return Turn(replace(status, state="lost", reason=reason, covariance_m2=None), carried)
    if after_jump:
        status = replace(status, reason="not looked for since a pose jumped")
    track = carried.track
    status = replace(
        status, position_m=track.position_m, covariance_m2=track.target_covariance_m2, stands_at=pose
    )
    return Turn(status, carried)


def _why(operation: Operation) -> str:
    """Why an operation brought nothing, in its own words."""
    return str((operation.error or {}).get("message", "the operation ended without a result"))
