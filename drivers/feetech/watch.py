"""What Feetech servos do by themselves while a head is driven: unload, restart, turn too fast."""

from __future__ import annotations

import logging

from drivers.errors import BadReply, HardwareFault, WatchdogTripped
from drivers.feetech.pair import FeetechAxis, FeetechPair
from drivers.feetech.servo import fault_words
from drivers.servo_bus.session import GivenUp

log = logging.getLogger(__name__)

TOO_FAST = 3.0
"""How many times the speed of its profile an axis may turn: a servo whose unit of speed is 50 counts turns 50
times as fast as one that was taken for one of 1 count."""

FAST_SPAN_S = 0.04


class FeetechWatch:
    """The watch over two servos, from when they were made ready until the line is given up.

    Attributes
    ----------
    tripped
        Whether a lease has run out under way; latched until `end_trip`.
    """

    def __init__(self, pair: FeetechPair, lease_s: float) -> None:
        self.tripped = False
        self._pair = pair
        self._lease_s = lease_s
        self._too_fast: dict[str, str] = {}
        self._before: dict[str, tuple[int, float]] = {}

    def heard_again(self, silence_s: float) -> None:
        """Stop for good after a silence longer than the lease of a way that is left. Raises LineLost."""
        under_way = any(axis.motion.sent is not None for axis in self._pair.axes)
        if self._lease_s and silence_s > self._lease_s and under_way and not self.tripped:
            self.tripped = True
            log.error("the head stood at the end of its lease: this process was silent for too long")
            self._pair.brake()

    def look_soon(self) -> None:
        """Nothing: each sample is looked at."""

    def look(self) -> None:
        """Look whether both servos are as they were left.

        Raises
        ------
        GivenUp
            If something set or restarted them that was not this driver.
        LineLost
            If the line is gone while an axis is braked that turns too fast.
        """
        for axis in self._pair.axes:
            sample = axis.motion.sample
            if sample is None:
                continue
            if axis.hardware_error and not sample.alert:
                log.warning("%s is well again", axis.servo.name)
                axis.hardware_error = ""
            if axis.motion.holds and not sample.values["torque_enable"]:
                if not axis.hardware_error:
                    words = f"{axis.servo.name} has its torque off: it restarted, or somebody else set it"
                    raise GivenUp(BadReply(words))
                axis.motion.limp()
            if (words := axis.motion.other_goal_words()) and not axis.hardware_error:
                raise GivenUp(BadReply(f"{words}: it restarted, or somebody else set it"))
            self._see_speed(axis)

    def _see_speed(self, axis: FeetechAxis) -> None:
        """Brake an axis that turns much faster than it was told."""
        sample, name, profile = axis.motion.sample, axis.servo.name, axis.motion.profile
        assert sample is not None
        before = self._before.get(name)
        if before is None or sample.received_s - before[1] >= FAST_SPAN_S:
            self._before[name] = sample.counts, sample.received_s
        if before is None or profile is None or sample.received_s - before[1] < FAST_SPAN_S:
            return
        unit = axis.settings.model.speed_unit_counts
        seen = abs(sample.counts - before[0]) / (sample.received_s - before[1])
        if axis.motion.holds and seen > TOO_FAST * profile[1] * unit + 8 / FAST_SPAN_S:
            self._too_fast[name] = (
                f"{name} turns at {seen:.0f} counts/s where {profile[1] * unit} were commanded: its "
                "firmware's unit of speed is another; set speed_unit_counts: 50, and open the head anew"
            )
            log.error("%s", self._too_fast[name])
            self._pair.brake()

    def note_alert(self, axis: FeetechAxis) -> None:
        """A servo reports a fault: brake both axes and say which. Raises LineLost."""
        sample = axis.motion.sample
        self._pair.brake()
        assert sample is not None
        axis.hardware_error = fault_words(axis.servo.name, sample.values["status"])
        if not sample.values["torque_enable"]:
            axis.hardware_error += "; its torque is off"
            axis.motion.limp()
        log.error("%s", axis.hardware_error)

    def check_free(self) -> None:
        """See that nothing forbids a move. Raises HardwareFault."""
        for axis in self._pair.axes:
            if words := axis.hardware_error or self._too_fast.get(axis.servo.name, ""):
                raise HardwareFault(words)
        if self.tripped:
            raise WatchdogTripped("the lease of a move ran out; stop lets the head move again")

    def arm(self) -> None:
        """Nothing: each goal is lent."""

    def arm_axis(self, axis: FeetechAxis) -> None:
        """Nothing."""

    def has_stopped(self, axis: FeetechAxis) -> bool:
        """Return False: an axis at the end of its lease obeys."""
        return False

    def end_trip(self) -> None:
        """Forget that a lease ran out: both axes stand, with their old goals void."""
        self.tripped = False

    def faults(self, now_s: float) -> tuple[str, ...]:
        """Return what is wrong, in plain words."""
        words = [axis.hardware_error for axis in self._pair.axes] + list(self._too_fast.values())
        if self.tripped:
            words.append("the lease of a move ran out: this process was silent for too long; stop ends it")
        words += [axis.motion.stuck_words(now_s) for axis in self._pair.axes]
        return tuple(word for word in words if word)
