"""A pan/tilt head of two Dynamixel servos (`drivers.interfaces.PanTilt`).

One thread owns the bus: it reads both servos in one transaction, at least ``poll_hz`` times a second, which
feeds their watchdogs; sends the second leg of a move that approaches its goal from one side; and comes back
after the line was lost. If this process dies, the servos stop by themselves within ``watchdog_s``.

Nothing here moves the head but `move`. When the servos' watchdog has stopped a motion, that is latched:
moving again needs a `stop` (or a new start) first. One that trips while the head stands at its goal has
interrupted nothing and is armed anew with a line in the log. A servo's reboot drops its torque and is done
only where the configuration says ``on_hardware_error: reboot``.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn, TypeVar

from drivers.clock import Clock, SystemClock
from drivers.dynamixel.bus import Bus
from drivers.dynamixel.link import GroupAnswer, Link, Part
from drivers.dynamixel.models import Register
from drivers.dynamixel.motion import AxisMotion, Sample, Truth, motion_block
from drivers.dynamixel.servo import WATCHDOG_TRIPPED, Servo, hardware_fault_words, velocity_counts
from drivers.dynamixel.settings import AxisSettings, HeadSettings, head_settings
from drivers.errors import (
    BadReply,
    DriverError,
    HardwareFault,
    LineLost,
    NoReply,
    OutOfRange,
    WatchdogTripped,
)
from drivers.interfaces import AxisReport, Reading, Reporting

log = logging.getLogger(__name__)
T = TypeVar("T")

CALL_TIMEOUT_S = 0.8  # the service waits 1 s
CLOSE_TIMEOUT_S = 2.0
ATTEMPTS, PATIENCE_S = 3, 0.15  # of a poll, before it counts as failed
FAILED_POLLS = 2  # in a row, before the servos are set up anew
FIRST_RETRY_S, LAST_RETRY_S = 0.1, 2.0
WATCH_S = 0.2  # how often torque and watchdog registers are looked at while all goes well
MOST_REBOOTS, REBOOT_SPAN_S = 3, 600.0
FAST_TRIALS = 10
AXES = ("pan", "tilt")


def open_head(options: Mapping[str, Any], clock: Clock | None = None) -> DynamixelHead:
    """Open the head that the options of ``driver: dynamixel`` describe; see `settings.HeadSettings`.

    Raises
    ------
    BadOptions
        For options that cannot be.
    LineLost, NoReply, WrongDevice, HardwareFault, Refused
        If the servos cannot be reached or do not fit; the line is closed again.
    """
    return DynamixelHead(head_settings(options), clock)


class DynamixelHead(Reporting):
    """The head; every method may be called from any thread.

    Parameters
    ----------
    settings
        What it is made of.
    clock
        Stamps the readings; deadlines run on the machine's monotonic clock.

    Raises
    ------
    LineLost, NoReply, WrongDevice, HardwareFault, Refused
        As `open_head`.
    """

    def __init__(self, settings: HeadSettings, clock: Clock | None = None) -> None:
        self.settings = settings
        self._clock = clock or SystemClock()
        self._axes: tuple[AxisSettings, AxisSettings] = (settings.pan, settings.tilt)
        names = [f"{axis} (servo {s.servo_id})" for axis, s in zip(AXES, self._axes, strict=True)]
        self._motions = [AxisMotion(n, s, settings.settle_s) for n, s in zip(names, self._axes, strict=True)]
        self._truths = [Truth(n, s) for n, s in zip(names, self._axes, strict=True)]
        self._blocks = [motion_block(s) for s in self._axes]
        self._parts = tuple(
            Part(s.servo_id, block.address, block.length)
            for s, block in zip(self._axes, self._blocks, strict=True)
        )
        self._link: Link | None = None
        self._servos: list[Servo] = []
        self._lost: DriverError | None = None
        self._retry_s, self._backoff_s = 0.0, FIRST_RETRY_S
        self._poll_due_s = self._polled_s = self._watched_s = 0.0
        self._failed_polls = 0
        self._hardware_errors: list[str] = ["", ""]
        self._reboots: list[float] = []
        self._tripped = False
        self._fast = False
        self._closed = False
        self._state = threading.Lock()
        self._connect()
        self._bus = Bus(settings.port, self._round)

    # What the service calls

    def read(self) -> Reading:
        """Return what both servos measure now.

        Raises
        ------
        LineLost, NoReply, BadReply, WrongDevice, HardwareFault
            If they cannot be read, at once while the line is known to be lost.
        """
        return self._call("read", self._read_now)

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        """Start both axes together towards the angles, rounded to the nearest count, and return.

        Raises
        ------
        OutOfRange
            For an angle outside the limits or a speed that is no positive number; nothing moves.
        HardwareFault, WatchdogTripped
            While a servo reports a hardware error, or the watchdog has stopped the head.
        LineLost, NoReply, BadReply
            If the servos do not confirm the goals.
        """
        speed = self.settings.speed_rad_per_s if speed_rad_per_s is None else speed_rad_per_s
        if not speed > 0:
            raise OutOfRange(f"speed {speed_rad_per_s} rad/s is not a positive number")
        for name, axis, angle in zip(AXES, self._axes, (pan_rad, tilt_rad), strict=True):
            low, high = axis.limits_rad
            if not low <= angle <= high:
                raise OutOfRange(
                    f"{name} {angle:.4f} rad is outside the head's limits {low:.4f} to {high:.4f} rad"
                )
        capped = min(speed, self.settings.speed_rad_per_s)
        self._call("move", lambda: self._move_now((pan_rad, tilt_rad), capped))

    def stop(self) -> None:
        """Brake both axes; each then holds or lets go as its ``at_stop`` says.

        After the watchdog has stopped the head this is the deliberate act that arms it anew.

        Raises
        ------
        LineLost, NoReply, BadReply
            If a servo did not confirm; the driver then keeps silent until the watchdog has stopped it.
        """
        self._call("stop", self._stop_now, first=True)

    def close(self) -> None:
        """Stop, leave each servo as its ``at_close`` says, and let go of the line; never raises."""
        with self._state:
            if self._closed:
                return
            self._closed = True
        self._bus.close(self._close_now, CLOSE_TIMEOUT_S)

    def report(self) -> dict[str, AxisReport]:
        """Return where each axis was sent and where it stood when it was last read; asks nobody."""
        reports = {axis: motion.report() for axis, motion in zip(AXES, self._motions, strict=True)}
        return {axis: report for axis, report in reports.items() if report is not None}

    # In the thread that owns the bus

    def _call(self, what: str, function: Callable[[], T], first: bool = False) -> T:
        with self._state:
            if self._closed:
                raise NoReply(f"the head on {self.settings.port} is closed; {what} was not sent")
        lost = self._lost
        if lost is not None:
            raise _again(lost)
        return self._bus.call(what, function, CALL_TIMEOUT_S, first=first)

    def _round(self) -> float:
        """What the thread does between calls; returns when it wants to be called again."""
        now_s = time.monotonic()
        if self._lost is not None:
            if now_s >= self._retry_s:
                self._come_back()
            return self._retry_s if self._lost is not None else self._poll_due_s
        if now_s >= self._poll_due_s:
            self._poll()
            self._watch()
        return self._retry_s if self._lost is not None else self._poll_due_s

    def _connect(self) -> None:
        """Open the line and make both servos ready, without moving them."""
        head = self.settings
        link = Link(head.port, head.baud, head.reply_timeout_s)
        try:
            servos = [Servo(link, name, axis, head) for name, axis in zip(AXES, self._axes, strict=True)]
            for servo in servos:
                servo.check_identity()
            for servo in servos:
                servo.check_health()
                servo.check_place()
            for servo in servos:
                servo.set_up()
                servo.check_set_up()
            goals = [servo.take_hold() for servo in servos]
            self._link, self._servos = link, servos
            self._arm()
            for motion, truth, goal in zip(self._motions, self._truths, goals, strict=True):
                motion.begin(goal)
                truth.forget()
            self._fast = head.fast_read and self._prove_fast_read()
            self._hardware_errors, self._tripped, self._failed_polls = ["", ""], False, 0
            self._attempt_poll()
        except BaseException:
            self._link = None
            link.close()
            raise
        log.info("%s: %s", head.port, "; ".join(f"{s.name} is ready" for s in servos))

    def _arm(self) -> None:
        """Arm both watchdogs with one packet, and see that they are."""
        counts = self.settings.watchdog_counts
        if not counts:
            return
        self._write_together("bus_watchdog", [counts, counts])
        for servo in self._servos:
            if servo.get("bus_watchdog") != counts:
                servo.set("bus_watchdog", counts)
        self._watched_s = time.monotonic()

    def _come_back(self) -> None:
        """Try to open the line and set the servos up again."""
        try:
            self._connect()
        except DriverError as error:
            if str(error) != str(self._lost):
                log.warning("%s: still away: %s", self.settings.port, error)
            self._lost = error
            self._backoff_s = min(2 * self._backoff_s, LAST_RETRY_S)
            self._retry_s = time.monotonic() + self._backoff_s
            return
        log.warning("%s is back: limits and modes checked, the head stands still", self.settings.port)
        self._lost, self._backoff_s = None, FIRST_RETRY_S

    def _give_up(self, error: DriverError) -> None:
        """Close the line and try again later; without us the watchdogs stop the servos."""
        log.warning("%s; trying again in %.1f s", error, FIRST_RETRY_S)
        if self._link is not None:
            self._link.close()
            self._link = None
        self._lost, self._backoff_s = error, FIRST_RETRY_S
        self._retry_s = time.monotonic() + FIRST_RETRY_S

    def _open_link(self) -> Link:
        if self._link is None:
            raise _again(self._lost) if self._lost else NoReply(f"{self.settings.port} is not open")
        return self._link

    def _poll(self) -> None:
        """Read both servos, repeating what a bad line spoilt; may give the line up. Raises DriverError."""
        began_s = time.monotonic()
        for attempt in range(1, ATTEMPTS + 1):
            try:
                self._attempt_poll()
            except LineLost as error:
                self._give_up(error)
                raise
            except DriverError as error:
                self._polled_s = time.monotonic()
                self._poll_due_s = self._polled_s + 1 / self.settings.poll_hz
                if attempt < ATTEMPTS and self._polled_s - began_s < PATIENCE_S:
                    continue
                self._failed_polls += 1
                if self._failed_polls >= FAILED_POLLS:
                    self._give_up(error)
                raise
            self._failed_polls = 0
            return

    def _attempt_poll(self) -> None:
        """One group read, judged, and what follows from it."""
        link = self._open_link()
        answer = link.group_read(self._parts, fast=self._fast)
        now_s = time.monotonic()
        gap_s, self._polled_s = now_s - self._polled_s, now_s
        self._poll_due_s = now_s + 1 / self.settings.poll_hz
        if answer.missing:
            answer = self._ask_singly(answer)
        samples = [self._sample(answer, index) for index in range(2)]
        for truth, sample in zip(self._truths, samples, strict=True):
            truth.check(sample)
        for index, sample in enumerate(samples):
            self._motions[index].take(sample)
            if sample.alert and not self._hardware_errors[index]:
                self._note_hardware_error(index)
        if self.settings.watchdog_counts and gap_s > self.settings.watchdog_s / 2:
            self._watched_s = 0.0  # the servos may have stopped by themselves meanwhile
        for index, motion in enumerate(self._motions):
            goal = motion.next_leg()
            if goal is not None:
                self._servos[index].set("goal_position", goal)
                motion.begin_leg()

    def _ask_singly(self, answer: GroupAnswer) -> GroupAnswer:
        """Ask the servos that a group read left out one by one, so that the right one is named."""
        link = self._open_link()
        statuses, received_s = dict(answer.statuses), answer.received_s
        for part in self._parts:
            if part.servo_id in answer.missing:
                single = link.group_read([part])
                if single.missing:
                    raise single.missing[part.servo_id]
                statuses.update(single.statuses)
                received_s = single.received_s
        return GroupAnswer(statuses, {}, answer.sent_s, received_s)

    def _sample(self, answer: GroupAnswer, index: int) -> Sample:
        status = answer.statuses[self._axes[index].servo_id]
        values = self._blocks[index].decode(status.data)
        return Sample(values, status.alert, answer.sent_s, answer.received_s)

    def _note_hardware_error(self, index: int) -> None:
        """A servo reports a hardware error: say which, stop the other axis, follow the reboot policy."""
        servo, axis = self._servos[index], self._axes[index]
        error = servo.get("hardware_error")
        if not error:
            return
        words = hardware_fault_words(servo.name, error)
        if not servo.get("torque_enable"):
            words += "; its torque is off"
            self._motions[index].limp()
        self._hardware_errors[index] = words
        log.error("%s", words)
        self._hold_where_they_are([i for i in range(2) if i != index and not self._hardware_errors[i]])
        now_s = time.monotonic()
        self._reboots = [then_s for then_s in self._reboots if now_s - then_s < REBOOT_SPAN_S]
        if axis.on_hardware_error == "reboot" and len(self._reboots) < MOST_REBOOTS:
            self._reboots.append(now_s)
            self._give_up(HardwareFault(words, detail={"hardware_error": error}))
            raise HardwareFault(words, detail={"hardware_error": error})

    def _watch(self) -> None:
        """Look now and then, and after every silence, whether a watchdog has tripped or torque is gone."""
        now_s = time.monotonic()
        if self._link is None or now_s - self._watched_s < WATCH_S:
            return
        self._watched_s = now_s
        for register in ("bus_watchdog", "torque_enable"):
            values = self._read_together(register)
            if register == "bus_watchdog" and WATCHDOG_TRIPPED in values:
                self._note_trip()
            for index, value in enumerate(values):
                self._judge_watched(index, register, value)
        for motion in self._motions:
            if (words := motion.other_goal_words()) and not self._tripped and not any(self._hardware_errors):
                self._distrust(words)

    def _judge_watched(self, index: int, register: str, value: int | None) -> None:
        motion = self._motions[index]
        if value is None or self._hardware_errors[index]:
            return  # asked again soon, or known
        changed = register == "bus_watchdog" and value not in (
            self.settings.watchdog_counts,
            WATCHDOG_TRIPPED,
        )
        if changed or (register == "torque_enable" and bool(value) != motion.holds):
            self._distrust(f"{motion.name} has {value} in {register}")

    def _note_trip(self) -> None:
        """The watchdog of a servo has tripped: latch it if a motion was stopped, else arm it anew."""
        if self._tripped:
            return
        if not all(motion.at_goal() for motion in self._motions):
            self._tripped = True
            log.error("the bus watchdog has stopped the head: this process was silent for too long")
            return
        log.warning("the bus watchdog tripped while the head stood at its goal; it is armed anew")
        for servo in self._servos:
            servo.set("bus_watchdog", 0)
        self._arm()

    def _distrust(self, words: str) -> NoReturn:
        """Set both servos up anew: something changed them that was not this driver."""
        error = BadReply(f"{words}: it restarted, or somebody else set it")
        self._give_up(error)
        raise error

    def _read_together(self, register: str) -> list[int | None]:
        """One register of both servos; None where no answer came."""
        entries = [axis.model.registers[register] for axis in self._axes]
        parts = [
            Part(axis.servo_id, entry.address, entry.size)
            for axis, entry in zip(self._axes, entries, strict=True)
        ]
        answer = self._open_link().group_read(parts)
        return [
            entry.decode(answer.statuses[axis.servo_id].data) if axis.servo_id in answer.statuses else None
            for axis, entry in zip(self._axes, entries, strict=True)
        ]

    def _write_together(self, register: str, values: Sequence[int]) -> None:
        parts = [
            _part(axis.servo_id, [(axis.model.registers[register], value)])
            for axis, value in zip(self._axes, values, strict=True)
        ]
        self._open_link().group_write(parts)

    def _prove_fast_read(self) -> bool:
        """Whether the servos answer the fast group read, every time of some trials."""
        link = self._open_link()
        for _ in range(FAST_TRIALS):
            if link.group_read(self._parts, fast=True).missing:
                log.info("%s: no fast group read; the plain one is used", self.settings.port)
                return False
        return True

    # What calls do

    def _read_now(self) -> Reading:
        self._poll()
        self._watch()
        now_s = time.monotonic()
        samples = [motion.sample for motion in self._motions]
        pan, tilt = (
            motion.settings.angle_rad(sample.counts)
            for motion, sample in zip(self._motions, samples, strict=True)
            if sample is not None
        )
        received_s = max(sample.received_s for sample in samples if sample is not None)
        wire_s = min(0.5 * (received_s - min(s.sent_s for s in samples if s is not None)), now_s)
        moving = not all(motion.settled(now_s) for motion in self._motions)
        stamp_s = self._clock.now_s() - (now_s - received_s) - wire_s
        return Reading(pan, tilt, moving, stamp_s, tuple(self._fault_words(now_s)))

    def _fault_words(self, now_s: float) -> list[str]:
        words = [word for word in self._hardware_errors if word]
        if self._tripped:
            words.append(
                "the servos' bus watchdog has stopped the head since this process was silent for too long; "
                "stop arms it anew"
            )
        return words + [word for motion in self._motions if (word := motion.stuck_words(now_s))]

    def _move_now(self, angles_rad: Sequence[float], speed_rad_per_s: float) -> None:
        self._poll()
        self._watch()
        for words in self._hardware_errors:
            if words:
                raise HardwareFault(words)
        if self._tripped:
            raise WatchdogTripped(
                "the servos' bus watchdog has stopped the head; stop arms it anew, then move again"
            )
        for index, motion in enumerate(self._motions):
            if not motion.holds:
                motion.begin(self._servos[index].take_hold())
                self._arm()
        self._attempt_poll()
        head = self.settings
        speeds = [velocity_counts(axis, speed_rad_per_s) for axis in self._axes]
        goals = [
            motion.plan(angle_rad, speed_rad_per_s, head.acceleration_rad_per_s2)
            for motion, angle_rad in zip(self._motions, angles_rad, strict=True)
        ]
        self._send_goals(goals, speeds)

    def _send_goals(self, goals: Sequence[int], speeds: Sequence[int]) -> None:
        """Write speed and goal of both axes with one packet and see that they are held; twice if need be."""
        parts = [
            _part(
                axis.servo_id,
                [
                    (axis.model.registers["profile_velocity"], speed),
                    (axis.model.registers["goal_position"], goal),
                ],
            )
            for axis, goal, speed in zip(self._axes, goals, speeds, strict=True)
        ]
        for _ in range(ATTEMPTS):
            self._open_link().group_write(parts)
            self._poll()
            held = [motion.sample.values["goal_position"] for motion in self._motions if motion.sample]
            wanted = [motion.goal for motion in self._motions]  # a short first leg may have ended already
            if held == list(goals) or held == wanted:
                return
        self._watched_s = 0.0
        self._watch()
        if self._tripped:
            raise WatchdogTripped("the servos' bus watchdog stopped the head before the goals came")
        error = NoReply(f"the servos hold the goals {held} where {list(goals)} were sent {ATTEMPTS} times")
        self._give_up(error)  # one axis may be under way: silence stops it
        raise error

    def _hold_where_they_are(self, indices: Sequence[int]) -> None:
        """Brake some axes."""
        for index in indices:
            motion = self._motions[index]
            if motion.holds and motion.sample is not None:
                goal = motion.stopping_counts(self.settings.acceleration_rad_per_s2)
                self._servos[index].set("goal_position", goal)
                motion.halt(goal)

    def _stop_now(self) -> None:
        try:
            self._poll()
            if self._tripped:
                for motion, servo in zip(self._motions, self._servos, strict=True):
                    if motion.holds:
                        motion.begin(servo.take_hold())
                self._arm()
                self._tripped = False
                log.warning("the head is armed anew after its watchdog had stopped it")
                self._poll()
            healthy = [i for i in range(2) if not self._hardware_errors[i]]
            self._hold_where_they_are(healthy)
            for index in healthy:
                if self._axes[index].at_stop == "torque_off" and self._motions[index].holds:
                    self._servos[index].set("torque_enable", 0)
                    self._motions[index].limp()
        except DriverError as error:
            if self._link is not None:  # silence lets the watchdogs stop what we could not
                self._give_up(error)
            raise

    def _close_now(self) -> None:
        if self._link is None:
            return
        try:
            self._stop_now()
        except DriverError as error:
            log.warning("the head did not confirm the last stop: %s", error)
        if self._link is None:
            return
        for servo in self._servos:
            servo.release()
        self._link.close()
        self._link = None


def _part(servo_id: int, registers: Sequence[tuple[Register, int]]) -> Part:
    """What is written to one servo: neighbouring registers and their values."""
    data = b"".join(register.encode(value) for register, value in registers)
    return Part(servo_id, registers[0][0].address, len(data), data)


def _again(error: DriverError) -> DriverError:
    """The same error to raise once more (an exception object grows with every raise)."""
    return type(error)(str(error), detail=error.detail)
