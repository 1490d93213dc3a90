"""Driving two ready servos: reading them, moving them, stopping them, until the line is given up.

A session has no way back: when the servos have to be made ready again it raises `GivenUp`, and its owner
begins a new one.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress

from drivers.clock import Clock
from drivers.errors import BadReply, DriverError, LineLost, NoReply, WatchdogTripped
from drivers.interfaces import Reading
from drivers.servo_bus.pair import Rest, ServoAxis, ServoPair, SessionWatch, rests
from drivers.servo_bus.settings import HeadSettings

log = logging.getLogger(__name__)

ATTEMPTS, PATIENCE_S = 3, 0.15  # of a poll, before it counts as failed
FAILED_POLLS = 2  # in a row, before the servos are set up anew
STOP_PATIENCE_S = 0.2  # how long a stop waits for a confirmation that does not come
STANDS_S = 0.1
LEFT_WITHIN_S = 1.2  # how long a closing waits for both axes to stand before their torque goes off


class GivenUp(Exception):
    """The servos are not as this driver left them, or only silence can stop them: start anew.

    The owner of the line closes it and raises ``error`` instead.
    """

    def __init__(self, error: DriverError) -> None:
        super().__init__(str(error))
        self.error = error


def distrusted(reason: str) -> GivenUp:
    """Return what to raise where something changed the servos that was not this driver."""
    return GivenUp(BadReply(f"{reason}: it restarted, or another program set it"))


class ServoSession:
    """Two servos on one open line; for the one thread that owns it.

    The ``clock`` stamps the readings; deadlines run on that of the pair's line.
    ``poll_due_s``: when the servos want to be read again, seconds of the line's clock.
    """

    def __init__(self, pair: ServoPair, watch: SessionWatch, head: HeadSettings, clock: Clock) -> None:
        self.pair = pair
        self.poll_due_s = 0.0
        self._head = head
        self._stamps = clock
        self._clock = pair.clock
        self._watch = watch
        self._heard_s = -math.inf
        self._failed_polls = 0

    def update(self) -> None:
        """Read both servos and see whether they are as they should be.

        Raises GivenUp if the line is gone, polls failed again and again, or the servos have to be set up
        anew; NoReply, BadReply, Refused, WrongDevice if they cannot be read this time.
        """
        self._poll()
        self._watch.check()

    def _poll(self) -> None:
        """Poll both servos, repeating what a bad line spoilt; raises as `update`."""
        began_s = self._clock.now_s()
        for attempt in range(1, ATTEMPTS + 1):
            try:
                self.poll_once()
            except LineLost as error:
                raise GivenUp(error) from None
            except DriverError as error:
                now_s = self._clock.now_s()
                self.poll_due_s = now_s + 1 / self._head.poll_hz
                if attempt < ATTEMPTS and now_s - began_s < PATIENCE_S:
                    continue
                self._failed_polls += 1
                if self._failed_polls >= FAILED_POLLS:
                    raise GivenUp(error) from None
                raise
            self._failed_polls = 0
            return

    def poll_once(self) -> None:
        """Read both servos, take their samples, and do what follows from them.

        Raises GivenUp if a servo has to be rebooted; DriverError.
        """
        samples = self.pair.samples()
        now_s = self._clock.now_s()
        silence_s, self._heard_s = now_s - self._heard_s, now_s
        self.poll_due_s = now_s + 1 / self._head.poll_hz
        for axis, sample in zip(self.pair.axes, samples, strict=True):
            axis.motion.take(sample)
            if sample.alert and not axis.hardware_error:
                self._watch.note_alert(axis)
        self._watch.heard_again(silence_s)
        for axis in self.pair.axes:
            axis.go_on()
        if all(axis.motion.settled(now_s) for axis in self.pair.axes):
            self.poll_due_s = now_s + self._head.resting_poll_s

    def read(self) -> Reading:
        """Return what both servos measure now; raises as `update`."""
        self.update()
        now_s = self._clock.now_s()
        motions = [axis.motion for axis in self.pair.axes]
        samples = [motion.sample for motion in motions if motion.sample is not None]
        pan, tilt = (
            axis.settings.angle_rad(sample.counts)
            for axis, sample in zip(self.pair.axes, samples, strict=True)
        )
        received_s = max(sample.received_s for sample in samples)
        wire_s = min(0.5 * (received_s - min(sample.sent_s for sample in samples)), now_s)
        moving = not all(motion.settled(now_s) for motion in motions)
        stamp_s = self._stamps.now_s() - (now_s - received_s) - wire_s
        return Reading(pan, tilt, moving, stamp_s, self._watch.faults(now_s))

    def move(self, angles_rad: Sequence[float], speed_rad_per_s: float) -> None:
        """Start both axes together towards angles within their limits.

        Raises HardwareFault, WatchdogTripped while a servo reports a hardware error, or the watchdog has
        stopped the head; GivenUp as `update`, and if the servos do not confirm the goals: silence stops them;
        NoReply, BadReply, Refused, WrongDevice, LineLost if they cannot be read or set. Nothing moves, or
        where the goals were sent and then no answer came, both were commanded to brake.
        """
        self.update()
        self._watch.check_free()
        for axis in self.pair.axes:
            if not axis.motion.holds:
                axis.take_hold()
                self._watch.arm()
        self.poll_once()
        for axis, angle_rad in zip(self.pair.axes, angles_rad, strict=True):
            axis.motion.plan(angle_rad, speed_rad_per_s, axis.acceleration_rad_per_s2)
        try:
            self._send_goals([axis.settings.velocity_counts(speed_rad_per_s) for axis in self.pair.axes])
        except DriverError:  # the caller assumes that it stands
            with suppress(LineLost):
                self.pair.brake()
            raise

    def _send_goals(self, speeds: Sequence[int]) -> None:
        """Write profile and goal of both axes with one packet and see that the servos have them."""
        motions = [axis.motion for axis in self.pair.axes]
        for _ in range(ATTEMPTS):
            sent = self.pair.send_goals(speeds)
            self._poll()
            stored = [motion.sample.values["goal_position"] for motion in motions if motion.sample]
            wanted = [motion.goal for motion in motions]  # a short first leg may have ended already
            if stored == list(sent) or stored == wanted:
                return
        self._watch.check_soon()
        self._watch.check()
        if self._watch.tripped:
            raise WatchdogTripped("the servos' bus watchdog stopped the head before the goals came")
        raise GivenUp(  # one axis may be under way: silence stops it
            NoReply(f"the servos hold the goals {stored} where {list(sent)} were sent {ATTEMPTS} times")
        )

    def stop(self) -> None:
        """Brake both axes; each then holds.

        Raises GivenUp if a servo did not confirm: silence lets the watchdogs stop what this could not.
        """
        failed = self._stop_each()
        if failed:
            raise GivenUp(stop_error(self.pair, failed))
        if self._watch.tripped:
            self._watch.end_trip()

    def _stop_each(self) -> dict[ServoAxis, DriverError]:
        """Brake each axis by itself; returns those that did not confirm, and why."""
        try:
            self.pair.brake()
        except LineLost as error:
            return dict.fromkeys(self.pair.axes, error)
        # the one that was heard of last first: it is the one that will answer
        axes = sorted(self.pair.axes, key=lambda axis: -axis.motion.heard_s)
        return confirmed(axes, self._confirm, self._clock)

    def _confirm(self, axis: ServoAxis) -> None:
        """See that an axis brakes, or command it again; raises as `BusServo.sample_once` and
        `BusServo.set`."""
        motion = axis.motion
        goal = motion.goal
        sample = axis.servo.sample_once()
        motion.take(sample)
        if sample.alert and motion.holds and not axis.servo.get("torque_enable"):
            motion.limp()
        if not motion.holds:
            return
        stored = sample.values["goal_position"]
        strange = stored != goal or self._watch.tripped
        if strange and self._watch.has_stopped(axis):
            axis.take_hold()
            self._watch.arm_axis(axis)
        elif stored != goal or not motion.braking_well(goal, axis.acceleration_rad_per_s2):
            axis.brake()

    def end(self, until_s: float) -> bool:
        """Stop, leave each servo as its ``at_close`` says, and close the line. Raises `Overtaken` alone.

        A servo that does not confirm the stop keeps its watchdog. Returns whether one did not. ``until_s``
        as of `leave`.
        """
        try:
            failed = self._stop_each()
            leave(self.pair, failed, until_s)
        finally:
            self.pair.close()
        return bool(failed)


def confirmed(
    axes: Sequence[ServoAxis], confirm: Callable[[ServoAxis], object], clock: Clock
) -> dict[ServoAxis, DriverError]:
    """Have each axis confirm a stop by itself, again for a while; returns those that did not, and why."""
    failed: dict[ServoAxis, DriverError] = {}
    until_s = clock.now_s() + STOP_PATIENCE_S
    waiting = list(axes)
    while waiting and (not failed or clock.now_s() < until_s):
        for axis in tuple(waiting):
            try:
                confirm(axis)
            except DriverError as error:
                failed[axis] = error
            else:
                waiting.remove(axis)
                failed.pop(axis, None)
    return failed


def leave(pair: ServoPair, failed: Mapping[ServoAxis, DriverError], until_s: float) -> None:
    """Leave each axis that has confirmed the last stop as its ``at_close`` says. Raises `Overtaken` alone.

    Its torque goes off only when it stands. Each has until ``until_s`` of the line's clock for that, and at
    least 0.2 s: the other one may have taken long.
    """
    for axis in pair.axes:
        if axis in failed:
            log.warning("%s did not confirm the last stop: %s", axis.servo.name, failed[axis])
            continue
        limp = axis.settings.at_close == "torque_off"
        if limp:
            try:
                within_s = max(until_s - pair.clock.now_s(), 2 * STANDS_S)
                at_rest, sample = rests(axis.servo.sample, pair.clock, within_s, Rest(STANDS_S))
                limp = at_rest or not sample.values.get("torque_enable", True)
                if not limp:
                    log.warning("%s did not come to rest after a stop: its torque stays on", axis.servo.name)
            except DriverError as error:
                limp = False
                message = "%s keeps its torque, for it does not say whether it is at rest: %s"
                log.warning(message, axis.servo.name, error)
        axis.servo.release(limp)


def stop_error(pair: ServoPair, failed: Mapping[ServoAxis, DriverError]) -> DriverError:
    """Return the error of a stop that not every axis has confirmed."""
    error = next(iter(failed.values()))
    names = " and ".join(axis.servo.name for axis in failed)
    done = "".join(f"; {axis.servo.name} brakes" for axis in pair.axes if axis not in failed)
    message = f"{names} did not confirm the stop and may still move: {error}{done}"
    return type(error)(message, detail=error.detail)
