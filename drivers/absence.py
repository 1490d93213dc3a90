"""A device that is away: why, and when it is worth another try. No I/O; whoever asks knows the time."""

from __future__ import annotations

import copy

from drivers.errors import DriverError

FIRST_WAIT_S, LONGEST_WAIT_S = 0.1, 2.0


class Absence:
    """Whether a device is away. Each failed try doubles the wait before the next one, up to a bound.

    Attributes
    ----------
    error
        Why it is away; None while it is here.
    again_s
        When to try again, on the clock of the caller, seconds.
    """

    def __init__(self) -> None:
        self.error: DriverError | None = None
        self.again_s = 0.0
        self._wait_s = FIRST_WAIT_S

    def note(self, error: DriverError, now_s: float, silent_s: float = 0.0) -> None:
        """Note that it is away, or still away after a try; it is left alone for ``silent_s`` at least."""
        self.again_s = now_s + max(self._wait_s, silent_s)
        self._wait_s = min(2 * self._wait_s, LONGEST_WAIT_S)
        self.error = error

    def end(self) -> None:
        """Note that it is here."""
        self.error, self._wait_s = None, FIRST_WAIT_S

    def check(self) -> None:
        """Raise why it is away, if it is; each time a new error, since one grows with every raise."""
        error = self.error
        if error is not None:
            raise copy.copy(error)
