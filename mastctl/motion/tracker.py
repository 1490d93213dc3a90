"""The track of a daemon: started, carried over each motion of the rover, looked for, stopped.

A look is an operation like a pointing: one at a time, through the same limits, ended by the same stop. A
pose that comes while one runs waits for its end; if the rover moved meanwhile, the look's pictures belong to
no one pose and are thrown away, and the next look follows at once.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from calib.geometry.rig import Rig
from calib.geometry.rigid import Rigid
from calib.matching.handed_over import MatchedHandoff
from drivers.clock import Clock
from mastctl.control.machine import StateMachine
from mastctl.control.operations import OperationRunner
from mastctl.control.records import Operation
from mastctl.devices.limits import Limits
from mastctl.errors import BadRequest, MastctlError, NotNow
from mastctl.motion.requests import PixelTarget, PositionTarget
from mastctl.motion.settings import PointingSettings, TrackingSettings
from mastctl.motion.steps import DevicesLike, Steps
from mastctl.motion.target_look import Looker, TrackSighting
from mastctl.motion.track import (
    ACTIVE,
    Carried,
    LookOutcome,
    RoverPose,
    TrackStatus,
    TrackTurn,
    check_follows,
    clock_was_set,
    looked,
    motion_between,
    moved_on,
    stands,
    started,
)

log = logging.getLogger(__name__)

Told = Mapping[str, Any]

FIRST_POSE = (
    "the rover's first pose came while the track ran: how far the rover moved since the track began is not "
    "known; begin the track again"
)


class HoldingDevices(DevicesLike, Protocol):
    """What the tracker needs of `mastctl.devices.devices.Devices`."""

    def exposure_held(self) -> AbstractContextManager[None]: ...


class Tracker:
    """At most one track, and the rover's pose; safe to use from any thread, never blocks for a device.

    Parameters
    ----------
    operations
        Runs the looks.
    devices
        Head and cameras.
    rig, limits, clock
        The mast file in use, the head's limits, what stamps everything.
    settings
        Which pair looks, how far a pose may lie from the one before.
    on_matched
        Gets each hand-off's record, in the operation's thread; it may take its time.
    machine
        Is told when a track begins and ends; its publisher gets each change of the track. One of its own by
        default.
    """

    def __init__(
        self,
        operations: OperationRunner,
        devices: HoldingDevices,
        rig: Rig,
        limits: Limits,
        clock: Clock,
        settings: TrackingSettings | None = None,
        on_matched: Callable[[MatchedHandoff], None] = lambda matched: None,
        machine: StateMachine | None = None,
    ) -> None:
        self._machine = machine or StateMachine(clock)
        self._operations = operations
        self._devices = devices
        self._rig = rig
        self._limits = limits
        self._clock = clock
        self._settings = settings or TrackingSettings()
        self._on_matched = on_matched
        self._lock = threading.Lock()
        self._said: list[tuple[Any, ...]] = []  # of whoever holds the lock: level, words, what they are about
        self._status = TrackStatus()
        self._carried: Carried | None = None  # what is followed; None without a track
        self._waiting: list[RoverPose] = []  # poses that came while a look runs
        self._look_again = False
        self._left = False  # whether the rover left, by a refused pose, where what runs takes its pictures
        self._moved_s: float | None = None

    @property
    def status(self) -> TrackStatus:
        """What is known now."""
        return self._status

    @property
    def pose(self) -> RoverPose | None:
        """The newest pose, None before the first: then site and rover are one."""
        return self._status.pose

    @property
    def moved_s(self) -> float | None:
        """When the newest pose that moved the rover came, seconds of CLOCK_MONOTONIC; None before."""
        return self._moved_s

    def start(self, target: PixelTarget | PositionTarget, told: Told) -> Operation:
        """Begin a track with what a pixel shows, or with what is seen at a position of the rover frame.

        Raises
        ------
        NotNow
            ``busy`` if a track or an operation runs; else as `OperationRunner.start`.
        """
        with self._held():
            if self._status.state in ACTIVE:
                raise NotNow("busy", f"track {self._status.id} runs; stop it before another is started")

            def begin(looker: Looker) -> LookOutcome:
                if isinstance(target, PixelTarget):
                    return looker.begin_at_pixel(target)
                return looker.begin_at_position(np.array(target.position_m))

            operation = self._run(told, begin)
            pose = self._status.pose
            self._carried, self._waiting, self._look_again = None, [], False
            self._publish(
                TrackStatus(
                    state="starting", id=operation.id, stands_at=pose, pose=pose, operation=operation.id
                )
            )
            return operation

    def take_pose(
        self, pose: RoverPose, look: bool, stands_at: Callable[[RoverPose], None] = lambda pose: None
    ) -> str | None:
        """Take where the rover stands now; carry the track over and look for its target.

        Parameters
        ----------
        pose
            Where it stands.
        look
            Whether its target is looked for from there.
        stands_at
            Gets a pose that is not refused, before anything is looked for from it; must return at once.

        Returns
        -------
        operation
            The id of the look; None if there is no track, none is wanted, or none could be started.

        Raises
        ------
        BadRequest, NotNow
            If it is not later than the one before, or, while a track runs, if it has no covariance: then the
            track is lost if the rover moved.

        The first pose ends a track that began without one.
        """
        with self._held():
            before = self._status.pose
            check_follows(pose, before)
            active = self._status.state in ACTIVE
            if active and before is not None and pose.covariance is None:
                self._doubted(motion_between(before, pose))
                raise BadRequest(
                    "pose_without_covariance",
                    "covariance (6 rows of 6) or sigma of the motion since the pose before is missing; while "
                    "a track runs it says where to look",
                )
            if before is not None and clock_was_set(pose, before):
                words = "the clock of the rover's poses was set, or is another: %g s after %g s"
                self._say(logging.INFO, words, pose.time_s, before.time_s)
            stands_at(pose)
            if before is not None and not stands(motion_between(before, pose)):
                self._moved_s = pose.received_s
            status = replace(self._status, pose=pose)
            if active and before is None:
                self._end(status, FIRST_POSE)
                return None
            operation = status.operation
            if active:
                stood = status.stands_at
                if stood is not None and not stands(motion_between(stood, pose)):
                    status = replace(status, predicted=True)
                if operation is not None:
                    self._waiting.append(pose)
                    self._look_again = self._look_again or look
                else:
                    status = self._carry(status, pose)
                    status = self._looked_for(status) if look else status
                    operation = status.operation
            self._publish(status)
            return operation

    def look(self) -> Operation:
        """Look for the target from where the rover stands.

        Raises
        ------
        NotNow
            ``no_track`` if none runs, or the newest pose jumped away from it; ``busy`` if an operation runs.
        """
        with self._held():
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
        with self._held():
            if self._status.state not in ACTIVE:
                return None
            running = self._status.operation
            self._end(self._status, reason)
            return running

    def use_rig(self, rig: Rig, name: str) -> None:
        """Look by another mast file from now on; a track ends, since its key picture is of the former."""
        self.stop(f"mast file {name} came into use; the track's pictures belong to the former one")
        with self._held():
            self._rig = rig

    def use_settings(self, limits: Limits, settings: TrackingSettings) -> None:
        """Look within other limits and by other rules from now on."""
        with self._held():
            self._limits, self._settings = limits, settings

    @contextmanager
    def _held(self) -> Iterator[None]:
        """Hold the lock; what was said meanwhile is logged after it, since whoever writes a log may block."""
        said: list[tuple[Any, ...]] = []
        try:
            with self._lock:
                self._said = said
                yield
        finally:
            for level, words, *about in said:
                log.log(level, words, *about)

    # With the lock held

    def _say(self, level: int, words: str, *about: Any) -> None:
        """Have something logged when the lock is let go."""
        self._said.append((level, words, *about))

    def _end(self, status: TrackStatus, reason: str) -> None:
        """Follow nothing any more."""
        self._carried, self._waiting, self._look_again = None, [], False
        self._publish(replace(status, state="stopped", reason=reason, operation=None))
        self._say(logging.INFO, "track %s stopped: %s", status.id, reason)

    def _doubted(self, motion: Rigid) -> None:
        """Say that the target is lost if the rover moved by a pose that says too little to be followed."""
        if stands(motion):
            return
        self._left = True
        if self._carried is None:  # its start ends by that
            return
        # Whatever is found after this must be confirmed by both eyes.
        self._carried = replace(self._carried, track=replace(self._carried.track, state="lost"))
        way_m = float(np.linalg.norm(motion.translation_m))
        words = f"the rover moved by {way_m:.2f} m, and its pose was refused: it had no covariance"
        self._publish(replace(self._status, state="lost", predicted=True, reason=words))

    def _run(self, told: Told, work: Callable[[Looker], LookOutcome]) -> Operation:
        """Start an operation that looks; its outcome comes to `_ended`."""
        rig, outcomes = self._rig, list[LookOutcome]()
        self._left = False

        def run(record: Callable[[Any], None], cancelled: threading.Event) -> TrackSighting:
            steps = Steps(
                rig, self._devices, self._limits, self._clock, PointingSettings(), record, cancelled
            )
            with self._devices.exposure_held():
                outcome = work(Looker(steps, rig, self._limits, self._settings))
            outcomes.append(outcome)
            return outcome[1]

        return self._operations.start(
            told, run, lambda operation: self._ended(operation, outcomes[0] if outcomes else None)
        )

    def _begin_look(self, carried: Carried) -> Operation:
        """Start a look. Raises NotNow, Unable."""
        found_by = self._status.found_by
        operation = self._run({"track": self._status.id}, lambda looker: looker.look(carried.track, found_by))
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
        """Carry the track over to a pose, or say that the pose jumped."""
        assert self._carried is not None
        origin_m = self._rig.mast.translation_m
        return self._take(moved_on(status, self._carried, pose, origin_m, self._settings.most_step))

    def _take(self, turn: TrackTurn) -> TrackStatus:
        """Follow what came of something, have it logged, and return the status to publish."""
        self._carried = turn.carried
        self._said += turn.said
        return turn.status

    def _publish(self, status: TrackStatus) -> None:
        before = self._status
        if status.state == "lost" and (before.state, before.reason) != (status.state, status.reason):
            self._say(logging.WARNING, "track %s: %s", status.id, status.reason)
        self._status = replace(status, sequence=before.sequence + 1, changed_s=self._clock.now_s())
        self._machine.publisher.publish("track", "track", self._status)
        was, now = before.state in ACTIVE, status.state in ACTIVE
        if now and not was and status.id is not None:
            self._machine.track_began(status.id)
        if was and not now and before.id is not None:
            self._machine.track_ended(before.id)

    # In the operation's thread

    def _ended(self, operation: Operation, outcome: LookOutcome | None) -> None:
        """Take what a start or a look told, then the poses that waited for it; a defect ends the track."""
        try:
            self._taken(operation, outcome)
        except Exception as defect:
            words = f"the track met a defect of the program ({type(defect).__name__}); the log says more"
            self.stop(words)
            raise

    def _taken(self, operation: Operation, outcome: LookOutcome | None) -> None:
        matched = None if outcome is None else outcome[1].matched
        with self._lock:
            came = len(self._waiting)
            left = self._left_by(self._waiting)
            counts = self._status.operation == operation.id and self._status.state != "starting"
            counts = counts and not left and not self._left
        if matched is not None and counts:  # without the lock, for which a stop waits: it may take its time
            self._on_matched(matched)
        with self._held():
            if self._status.operation != operation.id:
                return  # stopped meanwhile
            waiting, self._waiting = self._waiting, []
            status = replace(self._status, operation=None)
            left = self._left_by(waiting[:came])
            if status.state == "starting":
                status = self._take(started(status, operation, outcome, left or self._left))
            elif self._left:
                pass  # it is lost, and says by what
            elif left:
                words = "the rover moved while the pictures were taken, so that they belong to no one pose"
                status = replace(status, reason=words)
            else:
                assert self._carried is not None
                status = self._take(looked(status, self._carried, operation, outcome))
            if self._carried is not None:
                for one in waiting:
                    status = self._carry(status, one)
                if self._look_again:
                    status = self._looked_for(status)
            self._publish(status)

    def _left_by(self, poses: Sequence[RoverPose]) -> bool:
        """Whether the rover left where it stood, by poses that came since; the lock is held."""
        stood = self._status.stands_at
        return stood is not None and any(not stands(motion_between(stood, one)) for one in poses)
