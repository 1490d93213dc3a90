"""With which exposure times a frame may have been taken: a change shows some frames after it was made."""

from __future__ import annotations

from dataclasses import dataclass

SETTLE_FRAMES = 4
"""So many frames stamped after a change may still show what was set before it: the one that was being read
out when it was made, and three more."""


@dataclass
class _Setting:
    """An exposure time and when it was in force; ``over_at`` is the first count that cannot show it."""

    exposure_s: float | None
    since_s: float
    until_s: float | None = None
    over_at: int | None = None


class ExposuresSet:
    """The exposure times that were set on one stream, as long as a frame may show them.

    Parameters
    ----------
    exposure_s
        What is in force from the first frame on, seconds; None if that is not known.
    """

    def __init__(self, exposure_s: float | None) -> None:
        self._settings = [_Setting(exposure_s, float("-inf"))]

    def change(self, exposure_s: float | None, began_s: float, ended_s: float) -> None:
        """Take in that another one was set, between two moments of CLOCK_MONOTONIC."""
        self._settings[-1].until_s = ended_s
        self._settings.append(_Setting(exposure_s, began_s))

    def of(self, sequence: int, stamp_s: float) -> tuple[float | None, float | None]:
        """Return a frame's exposure time and the longest that it may have; None for what is not known.

        Frames are asked for in their order; one that was stamped before a change knows nothing of it.
        """
        found: list[float | None] = []
        for setting in self._settings:
            if setting.until_s is not None and setting.over_at is None and stamp_s > setting.until_s:
                setting.over_at = sequence + SETTLE_FRAMES
            if setting.since_s <= stamp_s and (setting.over_at is None or sequence < setting.over_at):
                found.append(setting.exposure_s)
        while self._settings[0].over_at is not None and sequence >= self._settings[0].over_at:
            del self._settings[0]
        known = [exposure_s for exposure_s in found if exposure_s is not None]
        if len(known) < len(found):
            return None, None
        longest_s = max(known)
        return (longest_s if min(known) == longest_s else None), longest_s
