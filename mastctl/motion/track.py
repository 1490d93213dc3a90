"""The track of a daemon: started, carried over each motion of the rover, looked for, stopped.

A look is an operation like a pointing: one at a time, through the same limits, ended by the same stop. If a
pose that comes while one runs says that the rover moved, the look's images belong to no one pose and are
dropped, and the next look follows at once.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, Rigid, quaternion_of
from calib.matching.handoff import MatchedHandoff
from calib.matching.track import Track, moved_track
from drivers.clock import Clock
from mastctl.answers import Handover, PoseAnswer, TrackAnswer, TrackState
from mastctl.as_json import as_json
from mastctl.control.operations import Operation, OperationRunner
from mastctl.devices.devices import Devices
from mastctl.errors import BadRequest, MastctlError, NotNow
from mastctl.motion.pairs import TrackingSettings
from mastctl.motion.requests import TrackRequest
from mastctl.motion.search import TargetSearch, TrackSighting

log = logging.getLogger(__name__)

STILL_M, STILL_RAD = 0.005, 0.001
"""Within these of each other two poses are one, stated twice: an odometer's noise, no motion."""

LATE_S = 60.0
"""No pose is longer on its way. One that seems so was stamped by a clock that was set, or by another one."""

WITHOUT_COVARIANCE = (
    "the rover moved, and its pose was refused: it had no covariance, which says where to look; begin the "
    "track again"
)
ACTIVE: frozenset[TrackState] = frozenset({"starting", "tracking", "lost"})
FIRST_POSE = (
    "the rover's first pose came while the track ran: how far the rover moved since the track began is not "
    "known; begin the track again"
)

Outcome = tuple[Track, TrackSighting]


@dataclass(frozen=True, eq=False)
class RoverPose:
    """One pose of the rover.

    ``covariance`` is (6, 6) of the motion since the pose before: small rotation, rad², then translation, m²,
    both along the rover's axes of this pose, as `calib.matching.track.moved_track` has it. ``time_s`` is by
    the sender's clock. Both are None where not stated. ``received_s`` is of CLOCK_MONOTONIC.
    """

    site_from_rover: Rigid
    covariance: FloatArray | None = None
    time_s: float | None = None
    received_s: float = 0.0

    def as_json(self, now_s: float) -> PoseAnswer:
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
    `LATE_S`. Raises NotNow ``pose_runs_backwards`` for one that may have been delayed on its way.
    """
    if before is None or before.time_s is None or pose.time_s is None or pose.time_s > before.time_s:
        return
    if before.time_s - pose.time_s + pose.received_s - before.received_s <= LATE_S:
        raise NotNow(
            "pose_runs_backwards",
            f"time_s is {pose.time_s:g} s, which is not later than the pose before it ({before.time_s:g} s)",
        )


def motion_between(before: RoverPose, now: RoverPose) -> Rigid:
    """Return now_from_before: the rover frame of one pose in that of the other."""
    return now.site_from_rover.inverse @ before.site_from_rover


def is_still(motion: Rigid) -> bool:
    """Return whether a motion is none."""
    turned_rad = math.acos(min(1.0, max(-1.0, (float(np.trace(motion.rotation)) - 1) / 2)))
    return float(np.linalg.norm(motion.translation_m)) <= STILL_M and turned_rad <= STILL_RAD


@dataclass(frozen=True, eq=False)
class TrackStatus:
    """The track at one moment; ``sequence`` grows with each change.

    ``reason`` is one sentence, where one is needed. ``id`` is the operation that started the track,
    ``operation`` the running start or look. ``track`` is what is followed, or was, in the rover frame of
    ``stands_at``, the pose that it was carried to; ``predicted`` says that the rover moved since it was seen.
    ``pose`` is the newest. ``seen`` is what the last look saw, ``found_by`` the pair that found it last.
    """

    sequence: int = 0
    state: TrackState = "idle"
    reason: str = ""
    id: str | None = None
    predicted: bool = False
    track: Track | None = None
    stands_at: RoverPose | None = None
    pose: RoverPose | None = None
    seen: TrackSighting | None = None
    found_by: str = ""
    looks: int = 0
    handoffs: tuple[Handover, ...] = ()
    renewals: int = 0  # of the key picture
    operation: str | None = None
    changed_s: float = 0.0

    @property
    def position_m(self) -> FloatArray | None:
        """(3,) in the rover frame of ``stands_at``."""
        return None if self.track is None else self.track.position_m

    @property
    def covariance_m2(self) -> FloatArray | None:
        """(3, 3) of the position."""
        return None if self.track is None else self.track.target_covariance_m2

    def carried_to(self, pose: RoverPose, origin_m: FloatArray, most_step: float) -> TrackStatus | str:
        """Return it carried to a pose with a covariance, or why not: the pose jumped.

        ``origin_m`` is (3,), from where the target's range counts, rover frame; ``most_step`` the longest
        way, as a part of that range.
        """
        assert self.track is not None and self.stands_at is not None and pose.covariance is not None
        motion = motion_between(self.stands_at, pose)
        range_m = float(np.linalg.norm(self.track.position_m - origin_m))
        way_m = float(np.linalg.norm(motion.translation_m))
        if way_m > most_step * range_m:
            return (
                f"the pose jumped by {way_m:.2f} m with the target {range_m:.2f} m away; a track is carried "
                f"over at most {most_step:g} of the range at a time; begin the track again"
            )
        return replace(self, track=moved_track(self.track, motion, pose.covariance), stands_at=pose)

    def as_json(self, now_s: float) -> TrackAnswer:
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
            "misses": 0 if self.track is None else self.track.misses,
            "handoffs": list(self.handoffs),
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


class Tracker:
    """At most one track, and the rover's pose; safe to use from any thread, never blocks for a device.

    ``rig`` is the configured part of the mast file in use. ``on_matched`` gets each hand-off's record, in the
    operation's thread; it may take its time. ``moved_s`` is when the newest pose that moved the rover came,
    seconds of CLOCK_MONOTONIC; None before.
    """

    def __init__(
        self,
        operations: OperationRunner,
        devices: Devices,
        rig: Rig,
        clock: Clock,
        settings: TrackingSettings,
        on_matched: Callable[[MatchedHandoff], None],
    ) -> None:
        self.moved_s: float | None = None
        self._operations = operations
        self._devices = devices
        self._rig = rig
        self._clock = clock
        self._settings = settings
        self._on_matched = on_matched
        self._lock = threading.Lock()
        self._status = TrackStatus()
        self._looking_from: RoverPose | None = None  # where what runs takes its images
        self._moved = False  # whether the rover moved from there
        self._look_again = False

    @property
    def status(self) -> TrackStatus:
        """What is known now."""
        return self._status

    @property
    def pose(self) -> RoverPose | None:
        """The newest pose, None before the first: then site and rover are one."""
        return self._status.pose

    def start(self, request: TrackRequest, recorded: Mapping[str, Any]) -> Operation:
        """Begin a track with what a pixel shows, or with what is seen at a position of the rover frame.

        Raises NotNow ``busy`` if a track or an operation runs; else as `OperationRunner.start`.
        """
        with self._lock:
            if self._status.state in ACTIVE:
                raise NotNow("busy", f"track {self._status.id} runs; stop it before another is started")

            def begin(search: TargetSearch) -> Outcome:
                if request.pixel is not None:
                    return search.begin_at_pixel(request.pixel)
                return search.begin_at_position(np.array(request.position_m))

            pose = self._status.pose
            operation = self._run(recorded, begin, pose)
            self._look_again = False
            self._publish(
                TrackStatus(
                    state="starting", id=operation.id, stands_at=pose, pose=pose, operation=operation.id
                )
            )
            return operation

    def take_pose(self, pose: RoverPose, look: bool, on_taken: Callable[[RoverPose], None]) -> str | None:
        """Carry the track over to the rover's present pose and ``look`` for its target.

        The first pose ends a track that began without one. ``on_taken`` gets a pose that is not refused,
        before anything is looked for from it; it must return at once.

        Returns the id of the look; None if there is no track, none is wanted, or none could be started.
        Raises NotNow if the pose is not later than the one before; BadRequest if it has no covariance while a
        track runs. A track ends with a motion without one, and with a pose that jumped.
        """
        with self._lock:
            before = self._status.pose
            check_follows(pose, before)
            active = self._status.state in ACTIVE
            moved = before is not None and not is_still(motion_between(before, pose))
            if active and before is not None and pose.covariance is None:
                if moved:
                    self._end(self._status, WITHOUT_COVARIANCE)
                raise BadRequest(
                    "pose_without_covariance",
                    "covariance (6 rows of 6) or sigma of the motion since the pose before is missing; while "
                    "a track runs it says where to look",
                )
            on_taken(pose)
            if moved:
                self.moved_s = pose.received_s
            status = replace(self._status, pose=pose)
            if active and before is None:
                self._end(status, FIRST_POSE)
                return None
            if active:
                stood = self._looking_from if status.operation else status.stands_at
                moved = stood is not None and not is_still(motion_between(stood, pose))
                status = replace(status, predicted=status.predicted or moved)
                if status.track is not None:
                    origin_m, most_step = self._rig.mast.translation_m, self._settings.most_step
                    carried = status.carried_to(pose, origin_m, most_step)
                    if isinstance(carried, str):
                        self._end(status, carried)
                        return None
                    status = carried
                if status.operation is not None:
                    self._moved = self._moved or moved
                    self._look_again = self._look_again or look
                elif look:
                    status = self._looked_for(status)
            self._publish(status)
            return status.operation

    def look(self) -> Operation:
        """Look for the target from the rover's present pose.

        Raises NotNow ``no_track`` if none runs; ``busy`` if an operation runs.
        """
        with self._lock:
            status = self._status
            if status.state not in ACTIVE or status.track is None:
                raise NotNow("no_track", "no track runs that could be looked for")
            operation = self._begin_look(status, status.track)
            self._publish(replace(status, operation=operation.id))
            return operation

    def stop(self, reason: str) -> str | None:
        """End the track, if one runs; return the operation of it that runs, which is left to the caller."""
        with self._lock:
            if self._status.state not in ACTIVE:
                return None
            running = self._status.operation
            self._end(self._status, reason)
            return running

    def use_rig(self, rig: Rig, name: str) -> None:
        """Look by another mast file from now on; a track ends, since its key image is of the former."""
        self.stop(f"mast file {name} came into use; the track's pictures belong to the former one")
        with self._lock:
            self._rig = rig

    # The lock is kept

    def _end(self, status: TrackStatus, reason: str) -> None:
        """Follow nothing any more."""
        self._look_again = False
        self._publish(replace(status, state="stopped", reason=reason, operation=None))
        log.info("track %s stopped: %s", status.id, reason)

    def _run(
        self, recorded: Mapping[str, Any], work: Callable[[TargetSearch], Outcome], pose: RoverPose | None
    ) -> Operation:
        """Start an operation that looks from a pose; its outcome comes to `_ended`."""
        rig, outcomes = self._rig, list[Outcome]()
        self._moved = False
        self._looking_from = pose

        def run(record: Callable[[Any], None], cancelled: threading.Event) -> TrackSighting:
            search = TargetSearch(rig, self._devices, self._clock, self._settings, record, cancelled)
            with self._devices.exposure_fixed():
                outcomes.append(work(search))
            return outcomes[0][1]

        return self._operations.start(
            recorded, run, lambda operation: self._ended(operation, outcomes[0] if outcomes else None)
        )

    def _begin_look(self, status: TrackStatus, track: Track) -> Operation:
        """Start a look. Raises NotNow, Unable."""
        operation = self._run(
            {"track": status.id}, lambda search: search.find(track, status.found_by), status.stands_at
        )
        self._look_again = False
        return operation

    def _looked_for(self, status: TrackStatus) -> TrackStatus:
        """Begin a look unless that makes no sense now; the status says why not."""
        if status.track is None:
            return status
        try:
            return replace(status, operation=self._begin_look(status, status.track).id)
        except MastctlError as error:  # a pointing runs, or the service is closing
            return replace(status, reason=f"not looked for yet: {error}")

    def _started(self, status: TrackStatus, operation: Operation, outcome: Outcome | None) -> TrackStatus:
        """Follow what the first look saw; nothing if it failed or the rover moved meanwhile."""
        if outcome is None or self._moved:
            reason = "the rover moved while the track's first pictures were taken; start it again"
            if outcome is None:
                reason = _why(operation)
            ended = TrackStatus(state="idle", reason=reason, id=status.id, pose=status.pose)
            return replace(ended, state="stopped") if operation.state == "stopped" else ended
        track, seen = outcome
        log.info("track %s begins %.2f m away, by %s", status.id, seen.range_m, seen.pair)
        return replace(status, state="tracking", track=track, seen=seen, found_by=seen.pair)

    def _looked(self, status: TrackStatus, operation: Operation, outcome: Outcome | None) -> TrackStatus:
        """Take what a look saw from the pose that the track was carried to."""
        before = status.track
        assert before is not None
        status = replace(status, looks=status.looks + 1)
        if outcome is None and operation.state == "stopped":
            return replace(status, state="stopped", reason=_why(operation))
        if outcome is None:
            # Nothing was seen: both cameras must find the target again, as after a look without success.
            track = replace(before, state="lost", misses=before.misses + 1)
            return replace(status, state="lost", reason=_why(operation), track=track)
        track, seen = outcome
        if seen.pose_doubt and seen.state == "tracked":  # what is lost is logged with its whole reason
            log.warning("track %s: %s", status.id, seen.pose_doubt)
        status = replace(
            status,
            reason="; ".join(filter(None, (seen.reason, seen.pose_doubt))),
            track=track,
            seen=seen,
            renewals=status.renewals + seen.renewed,
        )
        if seen.state == "lost":
            return replace(status, state="lost")
        if seen.pair != status.found_by:
            log.info("track %s: %s hands over to %s", status.id, status.found_by, seen.pair)
            handed = Handover(from_pair=status.found_by, to_pair=seen.pair, range_m=seen.range_m)
            status = replace(status, handoffs=(*status.handoffs, handed))
        return replace(status, state="tracking", predicted=False, found_by=seen.pair)

    def _publish(self, status: TrackStatus) -> None:
        before = self._status
        if status.state == "lost" and (before.state, before.reason) != (status.state, status.reason):
            log.warning("track %s: %s", status.id, status.reason)
        self._status = replace(status, sequence=before.sequence + 1, changed_s=self._clock.now_s())
        self._operations.machine.publisher.publish("track", "track", self._status)
        if (before.state in ACTIVE) != (status.state in ACTIVE):
            self._operations.machine.follow(status.id if status.state in ACTIVE else None)

    # In the operation's thread

    def _ended(self, operation: Operation, outcome: Outcome | None) -> None:
        """Take what a start or a look saw, then the poses that waited for it; a defect ends the track."""
        try:
            self._taken(operation, outcome)
        except Exception as defect:
            self.stop(f"the track met a defect of the program ({type(defect).__name__}); the log says more")
            raise

    def _taken(self, operation: Operation, outcome: Outcome | None) -> None:
        matched = None if outcome is None else outcome[1].matched
        with self._lock:
            counts = self._status.operation == operation.id and self._status.state != "starting"
            counts = counts and not self._moved
        if matched is not None and counts:  # without the lock, for which a stop waits: it may take its time
            self._on_matched(matched)
        with self._lock:
            if self._status.operation != operation.id:
                return  # stopped meanwhile
            status = replace(self._status, operation=None)
            if status.state == "starting":
                status = self._started(status, operation, outcome)
            elif self._moved:
                reason = "the rover moved while the pictures were taken, so that they belong to no one pose"
                status = replace(status, reason=reason)
            else:
                status = self._looked(replace(status, stands_at=self._looking_from), operation, outcome)
            if status.state in ACTIVE and self._look_again:
                status = self._looked_for(status)
            self._publish(status)


def _why(operation: Operation) -> str:
    """Why an operation brought nothing."""
    return str((operation.error or {}).get("message", "the operation ended without a result"))
