"""The devices as the service uses them: one owner thread each, answers checked, the one door for moves.

Every call blocks for a bounded time and may come from any thread. The head is read all the time (50 times a
second while it moves, 20 while it rests), so that each frame gets the joint angles at its mid-exposure.
This module does not decide where to point, and an answer that cannot be true is an error. Only a reading,
which moves nothing, is asked for once more: no operation ends because one answer was lost on the line.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Protocol

from calib.geometry.mode import SensorMode
from calib.geometry.rig import JointErrors, Rig
from drivers.clock import Clock, deadlines_on
from drivers.errors import BadReply, DriverError, LineLost, NoReply
from drivers.interfaces import (
    COARSE_COUNT_RAD,
    AxisReport,
    Camera,
    CameraSetting,
    PanTilt,
)
from drivers.options import is_number
from mastctl.control.machine import StateMachine
from mastctl.control.standing import StandingFault
from mastctl.devices import joint_history
from mastctl.devices.cameras import Cameras
from mastctl.devices.fault_watch import FaultWatch, FaultWords
from mastctl.devices.frames import ASKED, KEPT_FRAMES, FrameStore, StampedFrame, check_known
from mastctl.devices.joint_history import HeadReading, JointHistory
from mastctl.devices.judge import REST_S, KeepOutJudge
from mastctl.devices.keep_out import Pair
from mastctl.devices.limits import Limits, SunDirection
from mastctl.devices.stops import AT_ONCE_S, PATIENCE_S, StopRequests
from mastctl.devices.thread import DeviceThread
from mastctl.errors import MastctlError, Stopped

log = logging.getLogger(__name__)

HEAD = "pan_tilt"
READ_TIMEOUT_S = 1.0
MOVE_TIMEOUT_S = 1.0
STOP_TIMEOUT_S = 1.0
MOVING_PERIOD_S = 0.02
RESTING_PERIOD_S = 0.05
WORDS = {
    "read": FaultWords("the head is read again"),
    "move": FaultWords("a later move is taken in time", late_is_fault=True),
}


class HardwareLike(Protocol):
    """What `drivers.open_hardware` gives, as far as it is used here."""

    @property
    def pan_tilt(self) -> PanTilt: ...
    @property
    def cameras(self) -> Mapping[str, Camera]: ...


class Devices:
    """The head and the cameras behind their threads.

    Parameters
    ----------
    hardware
        The opened drivers; closing them is left to their opener, after `close`.
    limits
        Limits and keep-outs, checked in `move` as the last thing before the driver is called.
    mast_digest
        SHA-256 (hex) of the mast file in use, part of every frame's facts.
    clock
        Stamps are judged against it; deadlines run on it too, or in real time if it is turned by hand.
    rig
        The mast file's content: image sizes, and which cameras ride on the head. Without it sizes are
        not checked and no camera is taken for frozen.
    camera_grace_s
        How long past its time a camera may take before it counts as hanging, seconds; 3 by default.
    new_run
        As in `mastctl.devices.frames.FrameStore`.
    sun
        What the head cameras must not look into at first.
    machine
        Is told whether the head moves and what is wrong with it; its publisher gets each reading, each
        frame's facts and each device's faults. One of its own by default.

    Attributes
    ----------
    on_turn
        Called in the head's own thread each time it is about to read, whatever comes of that; must not wait.
    door
        What judges the moves: ways round the keep-outs are asked there, and the sun is told there.
    fault_watch
        Tells each change of what is wrong; what the daemon knows of its own files is told there too.

    Raises
    ------
    BadOptions
        If the head says that it speeds up faster than the limits allow.
    """

    def __init__(
        self,
        hardware: HardwareLike,
        limits: Limits,
        mast_digest: str,
        clock: Clock,
        rig: Rig | None = None,
        camera_grace_s: float | None = None,
        new_run: Callable[[], str] | None = None,
        sun: SunDirection | None = None,
        machine: StateMachine | None = None,
    ) -> None:
        self._machine = machine or StateMachine(clock)
        self._publisher = self._machine.publisher
        self.on_turn: Callable[[], None] = lambda: None
        self._pan_tilt = hardware.pan_tilt
        self.door = KeepOutJudge(limits, hardware.pan_tilt, clock, HEAD, rig, sun)
        self._clock = clock
        self._time = deadlines_on(clock)
        self._joints = JointErrors() if rig is None else rig.joints
        self._history = JointHistory(self._joints)
        self._store = FrameStore(mast_digest, new_run=new_run, on_new=self._new_frame)
        self._gate = threading.Lock()
        self._blocks: dict[object, Stopped] = {}  # who lets no move out, and why
        self._closed = False
        self.temperatures_c: Mapping[str, float] = {}  # of the axes, replaced and never edited
        self._reported_s: Mapping[str, float] = {}  # what the head reports about itself, and since when
        # The last move's ticket and when it was taken, until the head was read at rest after it.
        self._moved: tuple[int, float] | None = None
        self._stop_lost = False  # a lost line kept a stop from the head, which was not read at rest since
        self._cameras = Cameras(
            hardware.cameras,
            self._store,
            self._history,
            self.read,
            HEAD,
            clock,
            self._time,
            rig,
            camera_grace_s,
        )
        self.fault_watch = FaultWatch(self._faults, HEAD, self._machine, self._time)
        self._head = DeviceThread(
            HEAD, between=self._poll, between_timeout_s=READ_TIMEOUT_S, words=WORDS, clock=self._time
        )
        patience_s = AT_ONCE_S if self._pan_tilt.info.stops_beside is True else PATIENCE_S
        self._stops = StopRequests(self._head, HEAD, lambda: self._pan_tilt.stop(), self._time, patience_s)
        self.fault_watch.begin()

    # The head

    @property
    def last_reading(self) -> HeadReading | None:
        """The last good reading of the head, None before the first; its age is the clock minus its time_s."""
        return self._history.newest

    def read(self) -> HeadReading:
        """Return the joint state measured now; what was not answered properly is asked for once more.

        Raises
        ------
        NoReply, BadReply, DriverError
            If the head does not answer in 1 s, both questions together, or answers what cannot be true. The
            error is that of the first question.
        """
        until_s = self._time.now_s() + READ_TIMEOUT_S
        try:
            return self._head.call("read", self._read_once, READ_TIMEOUT_S)
        except (NoReply, BadReply) as error:
            left_s = until_s - self._time.now_s()
            if left_s <= 0:
                raise
            try:
                return self._head.call("read", self._read_once, left_s)
            except DriverError:
                raise error from None

    def report(self) -> Mapping[str, AxisReport]:
        """Return where each axis was sent and stands in counts; empty for a head that does not know.

        Raises
        ------
        NoReply, BadReply, DriverError
            If the head does not tell within 1 s, or tells something else.
        """
        return self._head.call("report", self._reported, READ_TIMEOUT_S, told=False)

    @property
    def reading_sigma_rad(self) -> Pair:
        """What a reading of pan and tilt may be off by, one sigma: that of a count, 12-bit if not stated."""
        pan, tilt = (self.counts_rad.get(axis, COARSE_COUNT_RAD) for axis in ("pan", "tilt"))
        return pan / math.sqrt(12.0), tilt / math.sqrt(12.0)

    @property
    def counts_rad(self) -> Mapping[str, float]:
        """One count of ``pan`` and of ``tilt``, as far as the head says it."""
        return self.door.counts_rad

    def goal(self, true_rad: Pair, here: HeadReading) -> Pair:
        """Return the readings to send the head to, so that it comes to true angles.

        By the mast file's joints. The side from which each axis will come follows from where it stands, and
        from whether the head comes to its goals from one side by itself. Nearer than half the play to where
        that side changes no goal leads to the angle: the one returned leads past it, by the play at most.

        Parameters
        ----------
        true_rad
            (pan, tilt) wanted.
        here
            Where the head rests.
        """
        pan, tilt = (
            joint.goal_rad(wanted, read, came, turn)
            for joint, wanted, read, came, turn in zip(
                (self._joints.pan, self._joints.tilt),
                true_rad,
                (here.pan_rad, here.tilt_rad),
                here.approach,
                self.door.turns_to(self._joints.read_rad(true_rad)),
                strict=True,
            )
        )
        return pan, tilt

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        """Start the head towards angles that it is to read, radians, and return; at most at the speed cap.

        Raises
        ------
        OutsideLimits, KeptOut
            If an angle or the speed may not be commanded, or the head might pass a keep-out on its way;
            nothing was sent.
        Stopped
            If a stop came first, moves are blocked, or a stop has not come back from the driver yet;
            nothing was sent.
        NoReply, DriverError
            If the head does not take the command in 1 s.
        """
        ticket = self._stops.ticket()
        goal = float(pan_rad), float(tilt_rad)

        def check_free() -> None:
            with self._gate:
                if self._blocks:
                    why = next(iter(self._blocks.values()))
                    raise type(why)(str(why))
            self._stops.check(ticket)

        def send() -> None:
            check_free()
            self.door.limits.check(*goal)
            speed = self.door.limits.speed(speed_rad_per_s)
            start = self.door.check_move(goal, self._read_for_move)
            check_free()  # the head may have been read meanwhile
            self._history.move_sent(self._clock.now_s())
            self.door.sent(start, goal, speed)
            self._pan_tilt.move(*goal, speed)
            self._moved = ticket, self._time.now_s()

        self._head.call("move", send, MOVE_TIMEOUT_S)

    def check_from(self, here: Pair, goal: Pair) -> None:
        """Pass a goal that may be commanded from a place (`KeepOutJudge.check_from`)."""
        self.door.check_from(here, goal)

    def stop(self) -> None:
        """Halt the head at once, whatever hangs (`mastctl.devices.stops`); moves still waiting are never
        sent.

        Raises
        ------
        NoReply, DriverError
            If the head did not confirm within 1 s; it may still move.
        """
        try:
            self._stops.send(STOP_TIMEOUT_S)
        except LineLost:
            self._stop_lost = True
            raise
        finally:
            self.fault_watch.look()

    def stops_returned(self, timeout_s: float) -> bool:
        """Return whether every stop has come back from the driver within ``timeout_s`` seconds."""
        return self._stops.returned(timeout_s)

    def block_moves(self, holder: object, reason: str | Stopped) -> None:
        """Refuse every further move until the holder (any key) allows them again.

        ``reason`` are the words, or the refusal itself, which is then told before those of others.
        """
        with self._gate:
            others = {other: why for other, why in self._blocks.items() if other is not holder}
            if isinstance(reason, Stopped):
                self._blocks = {holder: reason, **others}
            else:
                self._blocks = {**others, holder: Stopped(reason)}

    def allow_moves(self, holder: object) -> None:
        """Take back what this holder blocked; moves are taken when nobody blocks them."""
        with self._gate:
            self._blocks.pop(holder, None)

    # The cameras

    def frames(
        self, cameras: Sequence[str], exposed_after_s: float, timeout_s: float
    ) -> dict[str, StampedFrame]:
        """Return one frame of each camera, with its facts; see `mastctl.devices.cameras.Cameras.frames`."""
        return self._cameras.frames(cameras, exposed_after_s, timeout_s)

    def glance(
        self, camera: str, exposed_after_s: float, max_age_s: float, timeout_s: float, told: bool = False
    ) -> StampedFrame:
        """Return a frame for who only watches; see `mastctl.devices.cameras.Cameras.glance`."""
        return self._cameras.glance(camera, exposed_after_s, max_age_s, timeout_s, told)

    def frame_by_id(self, frame_id: str, max_age_s: float | None = None) -> StampedFrame:
        """Return a frame that is still kept. Raises NotKnown, NoLonger, NotNow."""
        return self._cameras.frame_by_id(frame_id, max_age_s)

    def hold(self, frame: StampedFrame, by: str = ASKED, kept: int = KEPT_FRAMES) -> None:
        """Keep a frame for who looks at it, as `mastctl.devices.frames.FrameStore.hold`."""
        self._cameras.hold(frame, by, kept)

    def let_go(self, by: str) -> None:
        """Hold nothing more for somebody."""
        self._cameras.let_go(by)

    def newest_frames(self) -> dict[str, StampedFrame | None]:
        """Return each configured camera's newest frame, None where there is none yet; asks no camera."""
        return self._cameras.newest_frames()

    def exposure_held(self) -> AbstractContextManager[None]:
        """Return a context in which every camera keeps its exposure, for a measurement."""
        return self._cameras.exposure_held()

    def camera_settings(self, camera: str) -> tuple[list[CameraSetting], bool]:
        """Return what a camera is set to, as `mastctl.devices.camera_settings.CameraControls.told`."""
        check_known(camera, self._cameras.newest_frames())
        return self._cameras.settings.told(camera)

    @property
    def sensor_modes(self) -> Mapping[str, SensorMode]:
        """Which pixels of its sensor each camera's pictures show, of those that are open and know it."""
        return self._cameras.sensor_modes

    def set_camera(self, camera: str, wanted: Mapping[str, float]) -> list[str]:
        """Change it, as `mastctl.devices.camera_settings.CameraControls.change`."""
        check_known(camera, self._cameras.newest_frames())
        return self._cameras.settings.change(camera, wanted)

    # All

    def use_rig(self, rig: Rig, mast_digest: str) -> None:
        """Stamp frames with another mast file from now on, and forget those that were stamped before."""
        self._cameras.use_rig(rig)
        self._joints = rig.joints
        self._history.use_joints(rig.joints)
        self.door.use_rig(rig)
        self._store.change_mast(mast_digest)

    def faults(self) -> tuple[StandingFault, ...]:
        """Return what is wrong with any device now, what the head reports about itself included."""
        self.fault_watch.look()
        return self._faults()

    def _faults(self) -> tuple[StandingFault, ...]:
        reported = [
            StandingFault(HEAD, "device_fault", f"{HEAD}: {word}", since_s, "the head no longer reports it")
            for word, since_s in self._reported_s.items()
        ]
        door = self.door.faults(self._history.newest)
        return (*self._head.faults(), *self._stops.faults(), *reported, *door, *self._cameras.faults())

    def errors(self) -> dict[tuple[str, str, str], int]:
        """Return how often calls have failed since the start: by device, call, and the error's code."""
        head = {(HEAD, *kind): count for kind, count in self._head.errors().items()}
        return head | self._cameras.errors()

    def frame_counts(self) -> dict[str, tuple[int, int]]:
        """Return how many frames were received and missed, of each camera whose driver counts them."""
        return self._cameras.counts()

    def close(self) -> None:
        """Stop the head and end the threads; takes some 4 s at most and never raises."""
        self.block_moves(self, "the service is closing")
        with self._gate:
            if self._closed:
                return
            self._closed = True
        try:
            self.stop()
        except (DriverError, MastctlError) as error:
            log.error("the head did not confirm the last stop: %s", error)
        until_s = self._time.now_s() + 2.0
        self._head.close(max(0.1, until_s - self._time.now_s()))
        self._cameras.close(until_s)
        self.fault_watch.close()

    # In the devices' own threads

    def _read_for_move(self) -> HeadReading:
        try:
            return self._read_once()
        except (NoReply, BadReply):
            return self._read_once()  # one answer lost on the line moves nothing and stops nothing

    def _read_once(self) -> HeadReading:
        answer = self._pan_tilt.read()
        newest = self._history.newest
        checked = joint_history.checked(
            answer, HEAD, self._clock.now_s(), None if newest is None else newest.time_s
        )
        reading = self._history.add(checked)
        if set(reading.faults) != set(self._reported_s):
            before_s = self._reported_s
            self._reported_s = {word: before_s.get(word, reading.time_s) for word in reading.faults}
            log.warning("%s reports: %s", HEAD, "; ".join(reading.faults) or "healthy again")
        if self._stop_lost and not reading.moving:
            self._stop_lost = False
            self._stops.rests()
        if self._moved is not None and not reading.moving:
            ticket, moved_s = self._moved
            if self._time.now_s() - moved_s > REST_S:
                self._moved = None
                self._stops.proved(ticket)
        self._machine.head_read(reading.moving)
        self._publisher.publish("joints", HEAD, reading)
        self.fault_watch.look()
        return reading

    def _new_frame(self, frame: StampedFrame) -> None:
        self._publisher.publish("frame", frame.camera, frame.facts)

    def _poll(self) -> float:
        self.on_turn()
        moving = self._read_once().moving
        try:
            told = self._reported()
        except Exception:  # of a driver from outside; the reading is good all the same
            told = {}
        warm = {name: axis.temperature_C for name, axis in told.items()}
        self.temperatures_c = {name: value for name, value in warm.items() if is_number(value)}
        return MOVING_PERIOD_S if moving else RESTING_PERIOD_S

    def _reported(self) -> Mapping[str, AxisReport]:
        head = self._pan_tilt
        reports = dict(head.report())
        for axis in reports.values():
            if not isinstance(axis, AxisReport):
                words = f"report returned {type(axis).__name__} where an AxisReport is expected"
                raise BadReply(words, device=HEAD)
        return reports
