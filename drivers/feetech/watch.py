"""What Feetech servos do by themselves while a head is driven: unload, restart, turn too fast."""

from __future__ import annotations

import logging

from drivers.errors import BadReply
from drivers.feetech.pair import FeetechAxis, FeetechPair
from drivers.feetech.servo import fault_words
from drivers.servo_bus.pair import SessionWatch
from drivers.servo_bus.session import GivenUp

log = logging.getLogger(__name__)

TOO_FAST = 3.0
"""How many times the speed of its profile an axis may turn: a servo whose unit of speed is 50 counts turns 50
times as fast as one that was taken for one of 1 count."""

FAST_SPAN_S = 0.04


class FeetechWatch(SessionWatch[FeetechAxis]):
    """The watch over two servos, as `SessionWatch`; a trip is a lease that has run out under way."""

    trip_words = "the lease of a move ran out: this process was silent for too long; stop ends it"
    trip_refusal = "the lease of a move ran out; stop lets the head move again"

    def __init__(self, pair: FeetechPair, lease_s: float) -> None:
        super().__init__(pair.axes)
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

    def own_words(self, axis: FeetechAxis) -> list[str]:
        """Return what forbids an axis to move: its servo's fault, a speed that was not commanded."""
        return [*super().own_words(axis), *filter(None, [self._too_fast.get(axis.servo.name)])]
