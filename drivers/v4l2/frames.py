"""What the capture thread hands out: frames as the camera gave them, and counts of what happened to them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.v4l2.node import Dequeued, PictureFormat
from drivers.v4l2.stamps import StampRule, Window, exposure_window


@dataclass(frozen=True, eq=False)
class RawFrame:
    """A frame as the camera gave it.

    Attributes
    ----------
    raw, format
        The bytes of the picture, uint8 (n,), and what they mean.
    sequence
        Our own count: it grows over every reopening.
    driver_sequence, stream
        The driver's count, which starts anew with each stream, and the stream's number.
    stamp_s, received_s
        The driver's stamp, and when the frame was dequeued, seconds of CLOCK_MONOTONIC.
    window
        In which the whole exposure lay.
    exposure_s
        The exposure time if it is known.
    """

    raw: NDArray[np.uint8]
    format: PictureFormat
    sequence: int
    driver_sequence: int
    stream: int
    stamp_s: float
    received_s: float
    window: Window
    exposure_s: float | None


@dataclass(frozen=True)
class Counters:
    """What happened to a camera's frames since it was opened.

    Attributes
    ----------
    good, damaged
        Frames that were published, and frames that were refused (error flag, length, stamp).
    dropped
        Frames that never came, by gaps in the driver's count.
    late
        Good frames that came more than a period and 5 ms after their stamp.
    reopened
        How often the camera was lost and opened again.
    last_damage
        What was wrong with the last refused frame.
    """

    good: int = 0
    damaged: int = 0
    dropped: int = 0
    late: int = 0
    reopened: int = 0
    last_damage: str = ""


class Arrived(NamedTuple):
    """A good frame in the kernel's memory; what can be worked out of it waits until somebody asks."""

    data: memoryview
    buffer: Dequeued
    format: PictureFormat
    rule: StampRule
    sequence: int
    stream: int
    received_s: float

    def window(self) -> Window:
        """Return in which the whole exposure lay."""
        return exposure_window(self.rule, self.buffer.flags, self.buffer.stamp_s, self.received_s)

    def frame(self, copy: bool) -> RawFrame:
        """Return it as a frame, in memory of its own or, until its buffer goes back, in the kernel's."""
        raw = np.frombuffer(self.data, np.uint8)
        return RawFrame(
            raw.copy() if copy else raw, self.format, self.sequence, self.buffer.sequence, self.stream,
            self.buffer.stamp_s, self.received_s, self.window(), self.rule.exposure_s,
        )  # fmt: skip
