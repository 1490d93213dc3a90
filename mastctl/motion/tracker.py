"""The track of a daemon: started, carried over each motion of the rover, looked for, stopped.

A look is an operation like a pointing: one at a time, through the same limits, ended by the same stop. A
pose that comes while one runs waits for its end; if the rover moved meanwhile, the look's images belong to
no one pose and are dropped, and the next look follows at once.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from calib.geometry.rig import Rig
from calib.geometry.rigid import Rigid
from calib.matching.handed_over import MatchedHandoff
from calib.matching.track import Track
from drivers.clock import Clock
from mastctl.control.machine import StateMachine
from mastctl.control.operations import OperationRunner
from mastctl.control.records import Operation
from mastctl.devices.limits import Limits
from mastctl.errors import BadRequest, MastctlError, NotNow
from mastctl.motion.head import DevicesLike
from mastctl.motion.poses import RoverPose, check_follows, clock_was_set, motion_between, stands
from mastctl.motion.requests import TrackRequest
from mastctl.motion.search import TargetSearch, TrackSighting
from mastctl.motion.settings import TrackingSettings
from mastctl.motion.track import ACTIVE, Carried, HandedOver, TrackStatus

log = logging.getLogger(__name__)

FIRST_POSE = (
    "the rover's first pose came while the track ran: how far the rover moved since the track began is not "
    "known; begin the track again"
)

Outcome = tuple[Track, TrackSighting]


class Tracker:
    """At most one track, and the rover's pose; safe to use from any thread, never blocks for a device.

    ``rig``, ``limits``: the part of the mast file in use that is configured, and the head's limits.
    ``on_matched``: gets each hand-off's record, in the operation's thread; it may take its time. ``machine``:
    gets the begin and the end of a track; its publisher each change of it. One of its own by default.

    ``moved_s``: when the newest pose that moved the rover came, seconds of CLOCK_MONOTONIC; None before.
    """

    def __init__(
        self,
        operations: OperationRunner,
        devices: DevicesLike,
        rig: Rig,
        limits: Limits,
        clock: Clock,
        settings: TrackingSettings | None = None,
        on_matched: Callable[[MatchedHandoff], None] = lambda matched: None,
        machine: StateMachine | None = None,
    ) -> None:
        self.moved_s: float | None = None
        self._machine = machine or StateMachine(clock)
        self._operations = operations
        self._devices = devices
        self._rig = rig
        self._limits = limits
        self._clock = clock
        self._settings = settings or TrackingSettings()
        self._on_matched = on_matched
        self._lock = threading.Lock()
        self._status = TrackStatus()
        self._carried: Carried | None = None  # what is followed; None without a track
        self._waiting: list[RoverPose] = []  # poses that came while a look runs
        self._look_again = False
        self._left = False  # whether the rover left, by a refused pose, where what runs takes its images

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

            operation = self._run(recorded, begin)
            pose = self._status.pose
            self._carried, self._waiting, self._look_again = None, [], False
            self._publish(
                TrackStatus(
                    state="starting", id=operation.id, stands_at=pose, pose=pose, operation=operation.id
                )
            )
            return operation

    def take_pose(
        self, pose: RoverPose, look: bool, on_taken: Callable[[RoverPose], None] = lambda pose: None
    ) -> str | None:
        """Carry the track over to the rover's present pose and ``look`` for its target.

        The first pose ends a track that began without one.

        ``on_taken``: gets a pose that is not refused, before anything is looked for from it; must return at
        once.

        Returns
        -------
        operation
            The id of the look; None if there is no track, none is wanted, or none could be started.

        Raises BadRequest, NotNow if it is not later than the one before, or, while a track runs, if it has no
        covariance: then the track is lost if the rover moved.
        """
        with self._lock:
            before = self._status.pose
            check_follows(pose, before)
            active = self._status.state in ACTIVE
            if active and before is not None and pose.covariance is None:
                self._lose(motion_between(before, pose))
                raise BadRequest(
                    "pose_without_covariance",
                    "covariance (6 rows of 6) or sigma of the motion since the pose before is missing; while "
                    "a track runs it says where to look",
                )
            if before is not None and clock_was_set(pose, before):
                message = "the clock of the rover's poses was set, or is another: %g s after %g s"
                log.info(message, pose.time_s, before.time_s)
            on_taken(pose)
            if before is not None and not stands(motion_between(before, pose)):
                self.moved_s = pose.received_s
            status = replace(self._status, pose=pose)
            if active and before is None:
                self._end(status, FIRST_POSE)
                return None
            if active:
                stood = status.stands_at
                if stood is not None and not stands(motion_between(stood, pose)):
                    status = replace(status, predicted=True)
                if status.operation is not None:
                    self._waiting.append(pose)
                    self._look_again = self._look_again or look
                else:
                    status = self._carry(status, pose)
                    status = self._looked_for(status) if look else status
            self._publish(status)
            return status.operation

    def look(self) -> Operation:
        """Look for the target from the rover's present pose.

        Raises NotNow ``no_track`` if none runs, or the newest pose jumped away from it; ``busy`` if an
        operation runs.
        """
        with self._lock:
            carried = self._carried
            if carried is None:
                raise NotNow("no_track", "no track runs that could be looked for")
            if carried.jumped:
                raise NotNow("no_track", self._status.reason)
            operation = self._begin_look(carried)
            self._publish(replace(self._status, operation=operation.id))
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

    def use_settings(self, limits: Limits, settings: TrackingSettings) -> None:
        """Look within other limits and by other rules from now on."""
        with self._lock:
            self._limits, self._settings = limits, settings

    # The lock is kept

    def _end(self, status: TrackStatus, reason: str) -> None:
        """Follow nothing any more."""
        self._carried, self._waiting, self._look_again = None, [], False
        self._publish(replace(status, state="stopped", reason=reason, operation=None))
        log.info("track %s stopped: %s", status.id, reason)

    def _lose(self, motion: Rigid) -> None:
        """Declare the target lost if the rover moved by a pose that says too little to be followed."""
        if stands(motion):
            return
        self._left = True
        if self._carried is None:  # its start ends by that
            return
        # Whatever is found after this must be confirmed by both cameras.
        self._carried = replace(self._carried, track=replace(self._carried.track, state="lost"))
        way_m = float(np.linalg.norm(motion.translation_m))
        reason = f"the rover moved by {way_m:.2f} m, and its pose was refused: it had no covariance"
        self._publish(replace(self._status, state="lost", predicted=True, reason=reason))

    def _run(self, recorded: Mapping[str, Any], work: Callable[[TargetSearch], Outcome]) -> Operation:
        """Start an operation that looks; its outcome comes to `_ended`."""
        rig, outcomes = self._rig, list[Outcome]()
        self._left = False

        def run(record: Callable[[Any], None], cancelled: threading.Event) -> TrackSighting:
            search = TargetSearch(
                rig, self._devices, self._limits, self._clock, self._settings, record, cancelled
            )
            with self._devices.exposure_held():
                outcomes.append(work(search))
            return outcomes[0][1]

        return self._operations.start(
            recorded, run, lambda operation: self._ended(operation, outcomes[0] if outcomes else None)
        )

    def _begin_look(self, carried: Carried) -> Operation:
        """Start a look. Raises NotNow, Unable."""
        found_by = self._status.found_by
        operation = self._run({"track": self._status.id}, lambda search: search.find(carried.track, found_by))
        self._look_again = False
        return operation

    def _looked_for(self, status: TrackStatus) -> TrackStatus:
        """Begin a look unless that makes no sense now; the status says why not."""
        if self._carried is None or self._carried.jumped:
            return status
        try:
            return replace(status, operation=self._begin_look(self._carried).id)
        except MastctlError as error:  # a pointing runs, or the service is closing
            return replace(status, reason=f"not looked for yet: {error}")

    def _carry(self, status: TrackStatus, pose: RoverPose) -> TrackStatus:
        """Carry the track over to a pose; it is lost if the pose jumped."""
        assert self._carried is not None
        after_jump = self._carried.jumped
        origin_m = self._rig.mast.translation_m
        self._carried, reason = self._carried.to(pose, origin_m, self._settings.most_step)
        if reason:
            return replace(status, state="lost", reason=reason, covariance_m2=None)
        if after_jump:
            status = replace(status, reason="not looked for since a pose jumped")
        track = self._carried.track
        return replace(
            status, position_m=track.position_m, covariance_m2=track.target_covariance_m2, stands_at=pose
        )

    def _started(
        self, status: TrackStatus, operation: Operation, outcome: Outcome | None, left: bool
    ) -> TrackStatus:
        """Follow what the first look saw; nothing if it failed or the rover ``left`` meanwhile."""
        if outcome is None or left:
            reason = "the rover moved while the track's first pictures were taken; start it again"
            if outcome is None:
                reason = _why(operation)
            ended = TrackStatus(state="idle", reason=reason, id=status.id, pose=status.pose)
            return replace(ended, state="stopped") if operation.state == "stopped" else ended
        track, seen = outcome
        log.info("track %s begins %.2f m away, by %s", status.id, seen.range_m, seen.pair)
        self._carried = Carried(track, status.stands_at)
        return replace(
            status,
            state="tracking",
            position_m=seen.position_m,
            covariance_m2=seen.covariance_m2,
            seen=seen,
            found_by=seen.pair,
        )

    def _looked(
        self, status: TrackStatus, carried: Carried, operation: Operation, outcome: Outcome | None
    ) -> TrackStatus:
        """Take what a look saw from the pose that the track was carried to."""
        status = replace(status, looks=status.looks + 1)
        if outcome is None and operation.state == "stopped":
            self._carried = None
            return replace(status, state="stopped", reason=_why(operation))
        if outcome is None:
            # Nothing was seen: both cameras must find the target again, as after a look without success.
            track = replace(carried.track, state="lost", misses=carried.track.misses + 1)
            self._carried = replace(carried, track=track)
            return replace(status, state="lost", reason=_why(operation), misses=track.misses)
        track, seen = outcome
        self._carried = replace(carried, track=track)
        if seen.pose_doubt and seen.state == "tracked":  # what is lost is logged with its whole reason
            log.warning("track %s: %s", status.id, seen.pose_doubt)
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
            return replace(status, state="lost")
        if seen.pair != status.found_by:
            log.info("track %s: %s hands over to %s", status.id, status.found_by, seen.pair)
            handed = HandedOver(status.found_by, seen.pair, seen.range_m)
            status = replace(status, handoffs=(*status.handoffs, handed))
        return replace(status, state="tracking", predicted=False, found_by=seen.pair)

    def _publish(self, status: TrackStatus) -> None:
        before = self._status
        if status.state == "lost" and (before.state, before.reason) != (status.state, status.reason):
            log.warning("track %s: %s", status.id, status.reason)
        self._status = replace(status, sequence=before.sequence + 1, changed_s=self._clock.now_s())
        self._machine.publisher.publish("track", "track", self._status)
        was, now = before.state in ACTIVE, status.state in ACTIVE
        if now and not was and status.id is not None:
            self._machine.track_began(status.id)
        if was and not now and before.id is not None:
            self._machine.track_ended(before.id)

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
            came = len(self._waiting)
            left = self._left or self._left_by(self._waiting)
            counts = self._status.operation == operation.id and self._status.state != "starting" and not left
        if matched is not None and counts:  # without the lock, for which a stop waits: it may take its time
            self._on_matched(matched)
        with self._lock:
            if self._status.operation != operation.id:
                return  # stopped meanwhile
            waiting, self._waiting = self._waiting, []
            status = replace(self._status, operation=None)
            left = self._left_by(waiting[:came])
            if status.state == "starting":
                status = self._started(status, operation, outcome, left or self._left)
            elif self._left:
                pass  # it is lost, with the reason
            elif left:
                reason = "the rover moved while the pictures were taken, so that they belong to no one pose"
                status = replace(status, reason=reason)
            else:
                assert self._carried is not None
                status = self._looked(status, self._carried, operation, outcome)
            if self._carried is not None:
                for one in waiting:
                    status = self._carry(status, one)
                if self._look_again:
                    status = self._looked_for(status)
            self._publish(status)

    def _left_by(self, poses: Sequence[RoverPose]) -> bool:
        """Whether the rover left its pose by poses that came since; the lock is kept."""
        stood = self._status.stands_at
        return stood is not None and any(not stands(motion_between(stood, one)) for one in poses)


def _why(operation: Operation) -> str:
    """Why an operation brought nothing."""
    return str((operation.error or {}).get("message", "the operation ended without a result"))
