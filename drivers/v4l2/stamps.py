"""When a frame was exposed, by its stamp and the exposure times that were set; whether a stamp can be true.

The kernel stamps a buffer at the start or at the end of a frame (docs/how-to/cameras.md). What is sure is a
*window*: the whole exposure, of all rows, lay inside it. A frame counts as fresh only if its window began
late enough, so every uncertainty makes the window longer and never lets an old frame pass.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from drivers.newest import ExposureWindow
from drivers.pixels import PictureFormat
from drivers.v4l2 import abi
from drivers.v4l2.node import Dequeued

AHEAD_S = 0.005
"""How far ahead of the clock a stamp may be: rounding, and drivers that estimate."""

READOUT_STAMPERS = ("uvcvideo",)
"""Drivers that say "start of exposure" but stamp the first packet, when the first row's exposure is over."""


@dataclass(frozen=True)
class StampRule:
    """What is known of a camera's time stamps.

    ``margin_s``, as configured: how much earlier than its stamp says an exposure may have begun.
    """

    margin_s: float
    driver: str = ""


class Timing(NamedTuple):
    """What is known of one frame's time beside its stamp.

    Attributes
    ----------
    exposure_s
        Its exposure time; None if it is not known (an automatic exposure, or a change under way).
    longest_s
        The longest exposure time that it may have; None if nothing but the frame before bounds it.
    apart_s
        It came at most so long after the frame before; None for the first of a stream.
    before_apart_s
        The same of the frame before, or of this one if that is more; None for the first two.
    """

    exposure_s: float | None
    longest_s: float | None
    apart_s: float | None
    before_apart_s: float | None


class Arrived(NamedTuple):
    """A good frame, without its picture: the kernel's buffer with the driver's own count and stamp.

    ``sequence`` is our own count, which grows over every reopening, ``stream`` the number of the stream.
    """

    buffer: Dequeued
    format: PictureFormat
    timing: Timing
    window: ExposureWindow
    sequence: int
    stream: int
    received_s: float
    settings: Mapping[str, float | None]


def exposure_window(
    rule: StampRule, timing: Timing, flags: int, stamp_s: float, received_s: float
) -> ExposureWindow | None:
    """Return the window of a frame's exposure, None if nothing says when that began at the earliest.

    No row is exposed before its last picture was read out, and one readout follows the other. So readout and
    exposure each take at most the time from frame to frame, T: this frame's own, never a promised or a usual
    one, since an automatic exposure stretches frames one by one. With e the longest exposure time that may
    have been set (where it is not known T, or U, the longer of T and that of the frame before), m the margin:

    - start-of-exposure stamps: [t - m, t + e + T], the last row up to a readout later;
    - start-of-exposure stamps of uvcvideo, which really mark the start of the readout: [t - e - m, t + T];
    - end-of-frame stamps: [t - T - e - m, t], with e = U where it is not known.

    No window ends after the frame was received, nor does a stamp count that is later than that.
    """
    stamp_s = min(stamp_s, received_s)
    apart_s, longest_s = timing.apart_s, timing.longest_s
    ends_s = received_s
    if flags & abi.BUF_FLAG_TSTAMP_SRC_MASK != abi.BUF_FLAG_TSTAMP_SRC_SOE:
        longest_s = timing.before_apart_s if longest_s is None else longest_s
        if apart_s is None or longest_s is None:
            return None
        begin_s, ends_s = stamp_s - apart_s - longest_s, stamp_s
    elif rule.driver in READOUT_STAMPERS:
        longest_s = apart_s if longest_s is None else longest_s
        if longest_s is None:
            return None
        begin_s = stamp_s - longest_s
        if apart_s is not None:
            ends_s = stamp_s + apart_s
    else:
        begin_s = stamp_s
        if apart_s is not None and longest_s is not None:
            ends_s = stamp_s + longest_s + apart_s
    begin_s -= rule.margin_s
    return ExposureWindow(begin_s, max(begin_s, min(ends_s, received_s)))


class Spacing:
    """How long after the frame before a frame came at most, by what the frames themselves show.

    ``promised_s`` is from frame to frame by the camera, seconds; None where it does not say.
    """

    def __init__(self, promised_s: float | None, margin_s: float) -> None:
        self._least_s = promised_s  # the shortest promised or seen: a frame that was lost took no less
        self._margin_s = margin_s
        self._last: tuple[int, float] | None = None
        self._apart_s: float | None = None

    def see(self, sequence: int, stamp_s: float) -> tuple[float | None, float | None]:
        """Take in the next good frame and return `Timing.apart_s` and `Timing.before_apart_s` of it.

        What lies between two frames that came is this frame's alone, but for what lost ones took at least.
        If there is no room for those, the count is not to be believed.
        """
        before, stamped_s = self._last or (sequence, stamp_s)
        self._last = sequence, stamp_s
        between_s, lost = stamp_s - stamped_s, sequence - before - 1
        if between_s <= 0.0:  # the first, or stamps that began again: nothing is known of what was before
            self._apart_s = None
            return None, None
        apart_s = between_s
        if lost == 0:
            seen_s = max(0.0, between_s - self._margin_s)
            self._least_s = seen_s if self._least_s is None else min(self._least_s, seen_s)
        elif self._least_s is not None and between_s >= (lost + 1) * self._least_s:
            apart_s = between_s - lost * self._least_s
        before_s, self._apart_s = self._apart_s, apart_s
        return apart_s, None if before_s is None else max(before_s, apart_s)


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
