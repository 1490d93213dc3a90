"""What is wrong with a device or a file at a moment, in plain words, and what takes it back."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class StandingFault:
    """Something wrong with a device, in plain words.

    Attributes
    ----------
    since_s
        When it began, seconds of CLOCK_MONOTONIC.
    until
        What takes it back, in plain words that follow "until".
    """

    device: str
    code: str
    message: str
    since_s: float
    until: str


@dataclass(frozen=True)
class FaultWords:
    """What belongs to the faults of one kind of call.

    Attributes
    ----------
    until
        What takes such a fault back, in plain words that follow "until".
    late_is_fault
        Whether an answer that came too late is a fault itself, because the call moves something; any other
        answer, however late, shows that the device works again.
    """

    until: str
    late_is_fault: bool = False
