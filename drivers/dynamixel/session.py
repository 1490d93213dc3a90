"""Driving two ready servos: reading them, moving them, stopping them, until the line is given up.

A session has no way back: when the servos have to be made ready again it raises `GivenUp`, and its owner
begins a new one.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

from drivers.clock import Clock
from drivers.dynamixel.pair import Pair
from drivers.dynamixel.servo import velocity_counts
from drivers.dynamixel.settings import HeadSettings
from drivers.dynamixel.watch import GivenUp, Reboots, Watch
from drivers.errors import DriverError, LineLost, NoReply, WatchdogTripped
from drivers.interfaces import Reading

ATTEMPTS, PATIENCE_S = 3, 0.15  # of a poll, before it counts as failed
FAILED_POLLS = 2  # in a row, before the servos are set up anew


class Session:
    """One line's life; for the one thread that owns it.

    Parameters
    ----------
    pair
        The servos, ready.
    head
        What the configuration says.
    clock
        Stamps the readings.
    reboots
        See `Watch`.

    Attributes
    ----------
    poll_due_s
        When the servos want to be read again, seconds of CLOCK_MONOTONIC.
    """

    def __init__(self, pair: Pair, head: HeadSettings, clock: Clock, reboots: Reboots) -> None:
        self.pair = pair
        self.poll_due_s = 0.0
        self._head = head
        self._clock = clock
        self._watch = Watch(pair, head, reboots)
        self._polled_s = 0.0
        self._failed_polls = 0

    def look(self) -> None:
        """Read both servos and see whether they are as they should be.

        Raises
        ------
        GivenUp
            If the line is gone, polls failed again and again, or the servos have to be set up anew.
        NoReply, BadReply, Refused, WrongDevice
            If they cannot be read this time.
        """
        self._poll()
        self._watch.look()

    def _poll(self) -> None:
        """Poll both servos, repeating what a bad line spoilt; raises as `look`."""
        began_s = time.monotonic()
        for attempt in range(1, ATTEMPTS + 1):
            try:
                self.poll_once()
            except LineLost as error:
                raise GivenUp(error) from None
            except DriverError as error:
                self._polled_s = time.monotonic()
                self.poll_due_s = self._polled_s + 1 / self._head.poll_hz
                if attempt < ATTEMPTS and self._polled_s - began_s < PATIENCE_S:
                    continue
                self._failed_polls += 1
                if self._failed_polls >= FAILED_POLLS:
                    raise GivenUp(error) from None
                raise
            self._failed_polls = 0
            return

    def poll_once(self) -> None:
        """Read both servos, take their samples, and do what follows from them.

        Raises
        ------
        GivenUp
            If a servo has to be rebooted.
        DriverError
            As `Pair.samples` and `Axis.go_on`.
        """
        samples = self.pair.samples()
        now_s = time.monotonic()
        gap_s, self._polled_s = now_s - self._polled_s, now_s
        self.poll_due_s = now_s + 1 / self._head.poll_hz
        for axis, sample in zip(self.pair.axes, samples, strict=True):
            axis.motion.take(sample)
            if sample.alert and not axis.hardware_error:
                self._watch.note_alert(axis)
        if self._head.watchdog_counts and gap_s > self._head.watchdog_s / 2:
            self._watch.look_soon()  # the servos may have stopped by themselves meanwhile
        for axis in self.pair.axes:
            axis.go_on()

    def read(self) -> Reading:
        """Return what both servos measure now; raises as `look`."""
        self.look()
        now_s = time.monotonic()
        motions = [axis.motion for axis in self.pair.axes]
        samples = [motion.sample for motion in motions if motion.sample is not None]
        pan, tilt = (
            axis.settings.angle_rad(sample.counts)
            for axis, sample in zip(self.pair.axes, samples, strict=True)
        )
        received_s = max(sample.received_s for sample in samples)
        wire_s = min(0.5 * (received_s - min(sample.sent_s for sample in samples)), now_s)
        moving = not all(motion.settled(now_s) for motion in motions)
        stamp_s = self._clock.now_s() - (now_s - received_s) - wire_s
        return Reading(pan, tilt, moving, stamp_s, self._watch.faults(now_s))

    def move(self, angles_rad: Sequence[float], speed_rad_per_s: float) -> None:
        """Start both axes together towards angles within their limits.

        Raises
        ------
        HardwareFault, WatchdogTripped
            While a servo reports a hardware error, or the watchdog has stopped the head.
        GivenUp
            As `look`, and if the servos do not confirm the goals: silence stops them.
        NoReply, BadReply, Refused, WrongDevice, LineLost
            If they cannot be asked or set; nothing moves.
        """
        self.look()
        self._watch.check_free()
        for axis in self.pair.axes:
            if not axis.motion.holds:
                axis.take_hold()
                self._watch.arm()
        self.poll_once()
        speeds = [velocity_counts(axis.settings, speed_rad_per_s) for axis in self.pair.axes]
        goals = [
            axis.motion.plan(angle_rad, speed_rad_per_s, self._head.acceleration_rad_per_s2)
            for axis, angle_rad in zip(self.pair.axes, angles_rad, strict=True)
        ]
        self._send_goals(goals, speeds)

    def _send_goals(self, goals: Sequence[int], speeds: Sequence[int]) -> None:
        """Write speed and goal of both axes with one packet and see that they are held."""
        motions = [axis.motion for axis in self.pair.axes]
        values = [
            [("profile_velocity", speed), ("goal_position", goal)]
            for goal, speed in zip(goals, speeds, strict=True)
        ]
        for _ in range(ATTEMPTS):
            self.pair.send(values)
            self._poll()
            held = [motion.sample.values["goal_position"] for motion in motions if motion.sample]
            wanted = [motion.goal for motion in motions]  # a short first leg may have ended already
            if held == list(goals) or held == wanted:
                return
        self._watch.look_soon()
        self._watch.look()
        if self._watch.tripped:
            raise WatchdogTripped("the servos' bus watchdog stopped the head before the goals came")
        raise GivenUp(  # one axis may be under way: silence stops it
            NoReply(f"the servos hold the goals {held} where {list(goals)} were sent {ATTEMPTS} times")
        )

    def stop(self) -> None:
        """Brake both axes; each then holds or lets go as its ``at_stop`` says.

        Raises
        ------
        GivenUp
            If a servo did not confirm: silence lets the watchdogs stop what this could not.
        """
        try:
            self._poll()
            if self._watch.tripped:
                self._watch.arm_anew()
                self._poll()
            healthy = [axis for axis in self.pair.axes if not axis.hardware_error]
            for axis in healthy:
                axis.brake()
            for axis in healthy:
                if axis.settings.at_stop == "torque_off" and axis.motion.holds:
                    axis.let_go()
        except DriverError as error:
            raise GivenUp(error) from None

    def end(self) -> None:
        """Leave each servo as its ``at_close`` says, and close the line; never raises."""
        self.pair.release()
        self.pair.close()
