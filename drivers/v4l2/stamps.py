"""When a frame was exposed, from its stamp; and whether the stamp can be true.

The kernel stamps a buffer at the start or at the end of a frame (docs/cameras.md). What is sure is a
*window*: the whole exposure, of all rows, lay inside it. A frame counts as fresh only if its window began
late enough, so every uncertainty makes the window longer and never lets an old frame pass.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from drivers.v4l2 import abi

AHEAD_S = 0.005
"""How far ahead of the clock a stamp may be: rounding, and drivers that estimate."""

READOUT_STAMPERS = ("uvcvideo",)
"""Drivers that say "start of exposure" but stamp the first packet, when the first row's exposure is over."""


@dataclass(frozen=True)
class StampRule:
    """What is known of a camera's time stamps.

    Attributes
    ----------
    period_s
        From one frame to the next: an unknown exposure lasts that long at most, and so does the readout.
    exposure_s
        The set exposure time, None if not known (an automatic exposure).
    margin_s
        The camera's configured margin: how much earlier than its stamp says an exposure may have begun.
    driver
        The kernel driver's name; those of `READOUT_STAMPERS` need a rule of their own.
    """

    period_s: float
    exposure_s: float | None
    margin_s: float
    driver: str = ""


class Window(NamedTuple):
    """A stretch of time in which the whole exposure lay, seconds of CLOCK_MONOTONIC."""

    begin_s: float
    end_s: float

    @property
    def mid_s(self) -> float:
        """The middle: the best guess of mid-exposure."""
        return (self.begin_s + self.end_s) / 2

    @property
    def length_s(self) -> float:
        return self.end_s - self.begin_s

    def mid_uncertainty_s(self, exposure_s: float | None) -> float:
        """The most that mid-exposure may be from the window's middle; less if the exposure is known."""
        return max(0.0, self.length_s - (exposure_s or 0.0)) / 2


def exposure_window(rule: StampRule, flags: int, stamp_s: float, received_s: float) -> Window:
    """Return the window of a frame's exposure.

    With T the period, e the exposure time (T when unknown), m the margin:

    - start-of-exposure stamps: [t - m, t + e + T], the last row up to a readout (at most T) later;
    - start-of-exposure stamps of uvcvideo, which really mark the start of the readout: [t - e - m, t + T];
    - end-of-frame stamps: [t - T - e - m, t], the readout having taken T at most.

    No window ends after the frame was received.

    Parameters
    ----------
    flags
        The buffer's flags.
    stamp_s, received_s
        The buffer's stamp, and when it was dequeued, seconds of CLOCK_MONOTONIC.
    """
    exposure_s = rule.period_s if rule.exposure_s is None else min(rule.exposure_s, rule.period_s)
    if flags & abi.BUF_FLAG_TSTAMP_SRC_MASK != abi.BUF_FLAG_TSTAMP_SRC_SOE:
        begin_s, end_s = stamp_s - rule.period_s - exposure_s, stamp_s
    elif rule.driver in READOUT_STAMPERS:
        begin_s, end_s = stamp_s - exposure_s, stamp_s + rule.period_s
    else:
        begin_s, end_s = stamp_s, stamp_s + exposure_s + rule.period_s
    begin_s -= rule.margin_s
    return Window(begin_s, max(begin_s, min(end_s, received_s)))


class StampCheck:
    """Judges the stamps and counts of one stream, frame by frame."""

    def __init__(self) -> None:
        self._sequence: int | None = None
        self._stamp_s: float | None = None

    def dropped_before(self, sequence: int) -> int:
        """Return how many frames are missing between the last frame and this one; counts wrap at 2^32."""
        last, self._sequence = self._sequence, sequence
        if last is None:
            return 0
        ahead = (sequence - last) % 2**32
        # A count that goes back is a driver's restart: nothing says how many frames it cost.
        return ahead - 1 if 0 < ahead < 2**31 else 0

    def wrong_stamp(self, flags: int, stamp_s: float, received_s: float) -> str:
        """Return why a stamp cannot be true; empty if it can."""
        if flags & abi.BUF_FLAG_TIMESTAMP_MASK != abi.BUF_FLAG_TIMESTAMP_MONOTONIC:
            return "its stamp is not of the monotonic clock"
        if stamp_s > received_s + AHEAD_S:
            return f"its stamp is {1e3 * (stamp_s - received_s):.1f} ms ahead of the clock"
        last_s, self._stamp_s = self._stamp_s, stamp_s
        if last_s is not None and stamp_s <= last_s:
            return f"its stamp is {1e3 * (last_s - stamp_s):.1f} ms before the last frame's"
        return ""
