"""What the capture thread hands out: frames as the camera gave them, and counts of what happened to them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from drivers.v4l2.node import Dequeued, PictureFormat
from drivers.v4l2.stamps import Timing, Window


@dataclass(frozen=True)
class Counters:
    """What happened to a camera's frames since it was opened.

    Attributes
    ----------
    good, damaged
        Frames that were published, and frames that were refused (error flag, length, stamp). The first one or
        two of a stream are neither, where nothing tells yet when their exposure began.
    dropped
        Frames that never came, by gaps in the driver's count.
    late
        Good frames that came more than a period and 5 ms after their stamp.
    reopened
        How often the camera was lost and opened again.
    last_damage
        What was wrong with the last refused frame.
    """

    good: int
    damaged: int
    dropped: int
    late: int
    reopened: int
    last_damage: str


class Arrived(NamedTuple):
    """A good frame, without its picture.

    Attributes
    ----------
    buffer, format
        The kernel's buffer with the driver's own count and stamp, and what its bytes mean.
    timing, window
        What is known of its exposure time, and in which the whole exposure lay.
    sequence, stream
        Our own count, which grows over every reopening, and the number of the stream.
    received_s
        When it was dequeued, seconds of CLOCK_MONOTONIC.
    """

    buffer: Dequeued
    format: PictureFormat
    timing: Timing
    window: Window
    sequence: int
    stream: int
    received_s: float
