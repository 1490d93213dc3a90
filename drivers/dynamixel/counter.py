"""A servo's own millisecond counter against our clock: whether an answer that holds it is of its question.

Once it is known at which moment of our clock the counter (Realtime Tick) showed what, an answer has to
show what the counter shows between our question and the answer's coming. That moment is kept as an interval
which good answers narrow, so that a chain of answers, each a little late, cannot carry it along. No I/O.
"""

from __future__ import annotations

from drivers.dynamixel.packets import GroupQuestion
from drivers.errors import BadReply, DriverError, LineLost
from drivers.servo_bus.exchange import BusLink
from drivers.servo_bus.port import QUIET_S, StatusPacket

MODULUS_S = 32.768
STEP_S = 0.001
SLACK_S = 0.003  # the servo takes its counter and its other registers at different moments of its own loop
DRIFT = 0.03  # its oscillator against ours

MEETING_SHAPES = ((12, 0), (8, 2), (4, 4), (0, 2), (8, 4), (4, 2), (12, 2), (0, 4))
"""Bytes read before and after the counter to get to know it; no two of the same length in all."""


class Counter:
    """One servo's counter, from the first answer that showed it.

    That was requested at ``sent_s`` and came at ``received_s``, seconds of our clock.
    """

    def __init__(self, tick: int, sent_s: float, received_s: float) -> None:
        self._tick = tick
        self._earliest_s, self._latest_s = sent_s - STEP_S, received_s  # when it began to show that

    def mismatch(self, tick: int, sent_s: float, received_s: float) -> str:
        """Take an answer as of its question, or return why it cannot be and take nothing."""
        passed_s = sent_s - self._earliest_s
        advance_s = (tick - self._tick) * STEP_S
        advance_s += MODULUS_S * round((passed_s - advance_s) / MODULUS_S)
        drift_s = DRIFT * abs(advance_s)
        earliest_s = self._earliest_s + advance_s - drift_s
        latest_s = self._latest_s + advance_s + drift_s
        if latest_s + STEP_S + SLACK_S < sent_s or earliest_s - SLACK_S > received_s:
            off_ms = 1000 * ((earliest_s + latest_s) / 2 - sent_s)
            when = f"{abs(off_ms):.0f} ms {'before' if off_ms < 0 else 'after'} the question"
            return f"a reply from another moment (late, repeated, or the servo restarted), {when}"
        self._tick = tick
        self._earliest_s = min(max(earliest_s, sent_s - STEP_S), latest_s)
        self._latest_s = max(min(latest_s, received_s), earliest_s)
        return ""


class TickCounters:
    """The counters of the servos on a line; for the thread that has it."""

    def __init__(self, link: BusLink) -> None:
        self._link = link
        self._clock = link.clock
        self._known: dict[int, Counter] = {}

    def forget(self, servo_id: int) -> None:
        """Get to know a servo's counter anew: it restarts."""
        self._known.pop(servo_id, None)

    def learn(self, question: GroupQuestion) -> DriverError | None:
        """Get to know the counters of a group's servos; returns why that failed. Raises LineLost."""
        for servo_id, at in question.ticks.items():
            if servo_id not in self._known:
                try:
                    self._meet(servo_id, question.parts[servo_id].address + at)
                except LineLost:
                    raise
                except DriverError as error:
                    return error
        return None

    def mismatch(self, question: GroupQuestion, status: StatusPacket, sent_s: float) -> BadReply | None:
        """Return why a reply that just came is not to this question; None if it is, or holds no counter."""
        servo_id = status.servo_id
        if servo_id not in question.ticks:
            return None
        at = question.ticks[servo_id]
        tick = int.from_bytes(status.data[at : at + 2], "little")
        mismatch = self._known[servo_id].mismatch(tick, sent_s, self._clock.now_s())
        if not mismatch:
            return None
        self._link.note_unexpected(status)
        return self._bad(servo_id, "group read", mismatch)

    def _meet(self, servo_id: int, tick_address: int) -> None:
        """Get to know a counter: by two answers, each after a silence, that agree about it.

        No question is repeated, so that no reply that is some questions late is of another.
        """
        shapes = iter(MEETING_SHAPES)
        for shape in shapes:
            counter = Counter(*self._tick(servo_id, tick_address, shape))
            mismatch = counter.mismatch(*self._tick(servo_id, tick_address, next(shapes)))
            if not mismatch:
                self._known[servo_id] = counter
                return
        raise self._bad(servo_id, "read", f"no two replies are of the moments of their questions: {mismatch}")

    def _tick(self, servo_id: int, address: int, shape: tuple[int, int]) -> tuple[int, float, float]:
        """The counter in a reply of so many bytes around it, and when that was requested and came."""
        before, after = shape
        self._link.quiet(QUIET_S)
        sent_s = self._clock.now_s()
        data = self._link.read(servo_id, address - before, before + 2 + after, "realtime_tick")
        return int.from_bytes(data[before : before + 2], "little"), sent_s, self._clock.now_s()

    def _bad(self, servo_id: int, instruction: str, reason: str) -> BadReply:
        return BadReply(
            f"servo {servo_id} on {self._link.name}: {reason}",
            detail=self._link.where(servo_id, instruction, "realtime_tick"),
        )
