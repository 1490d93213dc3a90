"""A servo's own millisecond counter against our clock: whether an answer that holds it is of its question.

Once it is known at which moment of our clock the counter (Realtime Tick) showed what, an answer has to
show what the counter shows between our question and the answer's coming. That moment is kept as an interval
which good answers narrow, so that a chain of answers, each a little late, cannot carry it along. No I/O.
"""

from __future__ import annotations

MODULUS_S = 32.768
STEP_S = 0.001
SLACK_S = 0.003  # the servo takes its counter and its other registers at different moments of its own loop
DRIFT = 0.03  # its oscillator against ours


class Counter:
    """One servo's counter, from the first answer that showed it.

    Parameters
    ----------
    tick
        What it showed, ms.
    sent_s, received_s
        When that was asked and when it came, seconds of our clock.
    """

    def __init__(self, tick: int, sent_s: float, received_s: float) -> None:
        self._tick = tick
        self._earliest_s, self._latest_s = sent_s - STEP_S, received_s  # when it began to show that

    def doubts(self, tick: int, sent_s: float, received_s: float) -> str:
        """Take an answer as of its question, or say in words why it cannot be and take nothing.

        Parameters
        ----------
        tick, sent_s, received_s
            As of the class.

        Returns
        -------
        str
            Empty if it is.
        """
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
