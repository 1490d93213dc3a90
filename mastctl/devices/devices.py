"""The devices as the service uses them: one owner thread each, answers checked, one judge of all moves.

Every call blocks for a bounded time and may come from any thread. The head is read all the time (50 times a
second while it moves, 20 while it rests), so that each frame gets the joint angles at its mid-exposure.
This module does not decide where to point, and an answer that cannot be true is an error. Only a reading,
which moves nothing, is tried once more: no operation ends because one answer was lost on the line.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Mapping, Sequence

from calib.geometry.rig import Rig
from drivers.clock import Clock
from drivers.errors import BadReply, DriverError, NoReply
from drivers.interfaces import COARSE_COUNT_RAD, AxisReport, Camera, PanTilt
from drivers.options import is_number
from mastctl.control.machine import StandingFault, StateMachine, same_faults
from mastctl.devices import joint_history
from mastctl.devices.cameras import CAMERA_GRACE_S, HEAD, Cameras
from mastctl.devices.frames import FrameStore, StampedFrame, random_run
from mastctl.devices.joint_history import HeadReading
from mastctl.devices.judge import KeepOutJudge, Limits, SunDirection
from mastctl.devices.keep_out import Pair
from mastctl.devices.thread import AT_ONCE_S, PATIENCE_S, DeviceThread, HeadThread
from mastctl.errors import MastctlError, Stopped

log = logging.getLogger(__name__)

READ_TIMEOUT_S = 1.0
MOVE_TIMEOUT_S = 1.0
STOP_TIMEOUT_S = 1.0
CLOSE_S = 2.0
WATCH_S = 0.1  # a call is overdue by the clock alone; so late that may show
MOVING_PERIOD_S = 0.02
RESTING_PERIOD_S = 0.05
FAULTS = {
    "read": "the head is read again",
    "move": "a later move is taken in time",
}


class Devices(Cameras):
    """The head and the cameras behind their threads; closing the drivers is left to their opener.

    Stamps are judged against the ``clock``; deadlines run on it too, or in real time if it is turned by hand.
    ``mast_digest`` is the SHA-256 (hex) of the mast file whose content is ``rig``; without that, image sizes
    are not checked and no camera is declared frozen. ``machine`` gets whether the head moves and what is
    wrong with it; its publisher each reading, each frame's facts and each device's faults.

    ``on_turn`` is called in the head's own thread each time it is about to read, whatever comes of that;
    ``latched`` returns what refuses every move while an emergency stop is latched. Neither may wait.
    ``reports`` says where each axis was sent and is in counts; empty for a head that does not know.

    Raises BadOptions if the head says that it speeds up faster than the limits allow.
    """

    def __init__(
        self,
        pan_tilt: PanTilt,
        cameras: Mapping[str, Camera],
        limits: Limits,
        mast_digest: str,
        clock: Clock,
        rig: Rig | None = None,
        camera_grace_s: float = CAMERA_GRACE_S,
        new_run: Callable[[], str] = random_run,
        sun: SunDirection | None = None,
        machine: StateMachine | None = None,
    ) -> None:
        self._machine = machine or StateMachine(clock)
        self._publisher = self._machine.publisher
        self.on_turn: Callable[[], None] = lambda: None
        self.latched: Callable[[], Stopped | None] = lambda: None
        self._pan_tilt = pan_tilt
        self.judge = KeepOutJudge(limits, pan_tilt, clock, HEAD, rig, sun)
        self._blocks: dict[object, str] = {}  # why no move is let out, by who blocks it
        self._closed = False
        self.reports: Mapping[str, AxisReport] = {}
        self._reported_s: Mapping[str, float] = {}  # what the head reports about itself, and since when
        store = FrameStore(mast_digest, new_run, self._new_frame)
        super().__init__(cameras, store, clock, rig, camera_grace_s)
        self._head = HeadThread(
            HEAD,
            lambda: self._pan_tilt.stop(),
            AT_ONCE_S if self._pan_tilt.info.stops_beside is True else PATIENCE_S,
            self._time,
            FAULTS,
        )
        self._head.poll("read", self._poll, READ_TIMEOUT_S)
        self._sources: tuple[Callable[[], Sequence[StandingFault]], ...] = (self._faults,)
        self._published: dict[str, tuple[StandingFault, ...]] = {}  # faults by device
        self._comparing = threading.Lock()
        self._watch = DeviceThread("faults", clock=self._time)
        self._watch.poll("check", self.check_faults, 1.0)

    @property
    def last_reading(self) -> HeadReading | None:
        """The last good reading of the head, None before the first; its age is the clock minus its time_s."""
        return self._history.newest

    def read(self) -> HeadReading:
        """Return the joint state measured now; what was not answered properly is tried once more.

        Raises NoReply, BadReply, DriverError, of the first try, if the head does not answer in 1 s, or
        answers what cannot be true.
        """
        return self._head.call("read", self._read_twice, READ_TIMEOUT_S)

    @property
    def temperatures_c(self) -> Mapping[str, float]:
        """Temperatures of the axes that report one."""
        warm = {name: axis.temperature_C for name, axis in self.reports.items()}
        return {name: value for name, value in warm.items() if is_number(value)}

    @property
    def reading_sigma_rad(self) -> Pair:
        """What a reading of pan and tilt may be off by, one sigma: that of a count, 12-bit if not stated."""
        pan, tilt = (self.judge.counts_rad.get(axis, COARSE_COUNT_RAD) for axis in ("pan", "tilt"))
        return pan / math.sqrt(12.0), tilt / math.sqrt(12.0)

    def goal(self, true_rad: Pair, start: HeadReading) -> Pair:
        """Return the readings to send a head to that rests at ``start``, so that it comes to true angles.

        The side from which each axis will come follows from where it is, and from whether the head comes to
        its goals from one side by itself. Nearer than half the play to where that side changes no goal leads
        to the angle: the one returned leads past it, by the play at most.
        """
        pan, tilt = (
            joint.goal_rad(wanted, read, came, turn)
            for joint, wanted, read, came, turn in zip(
                (self._joints.pan, self._joints.tilt),
                true_rad,
                (start.pan_rad, start.tilt_rad),
                start.approach,
                self.judge.turns_to(self._joints.read_rad(true_rad)),
                strict=True,
            )
        )
        return pan, tilt

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        """Start the head towards angles that it is to read, radians, and return; at most at the speed cap.

        Raises OutsideLimits, KeptOut; Stopped if a stop came first, moves are blocked, or a stop has not come
        back from the driver yet; nothing was sent then. Raises NoReply, DriverError if the head does not take
        the command in 1 s.
        """
        ticket = self._head.ticket()
        goal = float(pan_rad), float(tilt_rad)

        def check_free() -> None:
            refusal = self.latched()
            if refusal is not None:
                raise refusal
            if reasons := tuple(self._blocks.values()):
                raise Stopped(reasons[0])
            self._head.check(ticket)

        def send() -> None:
            check_free()
            self.judge.limits.check(*goal)
            speed = self.judge.limits.speed(speed_rad_per_s)
            start = self.judge.check_move(goal, self._read_twice)
            check_free()  # the head may have been read meanwhile
            self._history.move_sent(self._clock.now_s())
            self.judge.sent(start, goal, speed)
            self._pan_tilt.move(*goal, speed)

        self._head.call("move", send, MOVE_TIMEOUT_S)

    def stop(self) -> None:
        """Halt the head at once, whatever hangs; moves still waiting are never sent.

        Raises NoReply, DriverError if the head did not confirm within 1 s; it may still move.
        """
        try:
            self._head.stop(STOP_TIMEOUT_S)
        except BaseException:
            self.check_faults()  # the fault is published before the stop is over
            raise
        if self._machine.standing.faults:
            self.check_faults()

    def stops_returned(self, timeout_s: float) -> bool:
        """Return whether every stop has come back from the driver within ``timeout_s`` seconds."""
        return self._head.stops_returned(timeout_s)

    def block_moves(self, by: object, reason: str) -> None:
        """Refuse every further move until ``by``, any key, allows them again."""
        self._blocks[by] = reason

    def allow_moves(self, by: object) -> None:
        """Take back what was blocked by a key; moves go out when nothing blocks them."""
        self._blocks.pop(by, None)

    def use_rig(self, rig: Rig, mast_digest: str) -> None:
        """Stamp frames with another mast file from now on, and forget those that were stamped before."""
        self._calibrated = dict(rig.cameras)
        self._joints = rig.joints
        self._history.use_joints(rig.joints)
        self.judge.use_rig(rig)
        self.store.change_mast(mast_digest)

    def watch_faults(self, source: Callable[[], Sequence[StandingFault]]) -> None:
        """Have another source's faults published too: the daemon's own files. It must not wait."""
        self._sources = (*self._sources, source)

    def faults(self) -> tuple[StandingFault, ...]:
        """Return all that is wrong now, as the head reports it too; publish what has changed."""
        self.check_faults()
        return tuple(fault for faults in self._sources for fault in faults())

    def check_faults(self) -> float:
        """Publish what has changed as ``("fault", device, tuple)``; the machine is informed of the head's.

        A check that is under way is not waited for. Returns when to check again, seconds.
        """
        if self._comparing.acquire(blocking=False):
            try:
                by_device: dict[str, list[StandingFault]] = {}
                for fault in (one for faults in self._sources for one in faults()):
                    by_device.setdefault(fault.device, []).append(fault)
                for device in {*self._published, *by_device}:
                    now = tuple(by_device.get(device, ()))
                    if not same_faults(now, self._published.get(device, ())):
                        self._published[device] = now
                        self._publisher.publish("fault", device, now)
                        if device == HEAD:
                            self._machine.head_faults(now)
            finally:
                self._comparing.release()
        return WATCH_S

    def _faults(self) -> tuple[StandingFault, ...]:
        reported = [
            StandingFault(HEAD, "device_fault", f"{HEAD}: {fault}", since_s, "the head no longer reports it")
            for fault, since_s in self._reported_s.items()
        ]
        judged = self.judge.faults(self._history.newest)
        cameras = (fault for thread in self._threads.values() for fault in thread.faults())
        return (*self._head.faults(), *reported, *judged, *cameras)

    def errors(self) -> dict[tuple[str, str, str], int]:
        """Return how often calls have failed since the start: by device, call, and the error's code."""
        threads = {HEAD: self._head, **self._threads}
        return {(name, *kind): count for name, one in threads.items() for kind, count in one.errors().items()}

    def close(self) -> None:
        """Stop the head and end the threads; takes some 4 s at most and never raises."""
        self.block_moves(self, "the service is closing")
        if self._closed:
            return
        self._closed = True
        try:
            self.stop()
        except (DriverError, MastctlError) as error:
            log.error("the head did not confirm the last stop: %s", error)
        until_s = self._time.now_s() + CLOSE_S
        self._head.close(CLOSE_S)
        for thread in self._threads.values():
            thread.close(max(0.1, until_s - self._time.now_s()))
        self.check_faults()
        self._watch.close(CLOSE_S)

    # In the head's own thread

    def _read_twice(self) -> HeadReading:
        try:
            return self._read_once()
        except (NoReply, BadReply) as error:  # one answer lost on the line moves nothing and stops nothing
            try:
                return self._read_once()
            except DriverError:
                raise error from None

    def _read_once(self) -> HeadReading:
        answer = self._pan_tilt.read()
        newest = self._history.newest
        checked = joint_history.checked(
            answer, HEAD, self._clock.now_s(), None if newest is None else newest.time_s
        )
        reading = self._history.add(checked)
        if set(reading.faults) != set(self._reported_s):
            before_s = self._reported_s
            self._reported_s = {fault: before_s.get(fault, reading.time_s) for fault in reading.faults}
            log.warning("%s reports: %s", HEAD, "; ".join(reading.faults) or "healthy again")
        if not reading.moving:
            self._head.rests()
        self._machine.head_read(reading.moving)
        self._publisher.publish("joints", HEAD, reading)
        return reading

    def _new_frame(self, frame: StampedFrame) -> None:
        self._publisher.publish("frame", frame.camera, frame.facts)

    def _poll(self) -> float:
        self.on_turn()
        moving = self._read_once().moving
        try:
            reports = dict(self._pan_tilt.report())
            self.reports = {name: axis for name, axis in reports.items() if isinstance(axis, AxisReport)}
        except Exception:  # of a driver from outside; the reading is good all the same
            self.reports = {}
        return MOVING_PERIOD_S if moving else RESTING_PERIOD_S
