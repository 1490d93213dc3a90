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

    def same(self, other: StandingFault) -> bool:
        """Return whether both are one fault at two moments: its words or its time may have gone on."""
        return (self.device, self.code) == (other.device, other.code) and (
            self.since_s == other.since_s or self.message == other.message
        )


def same_faults(some: tuple[StandingFault, ...], others: tuple[StandingFault, ...]) -> bool:
    """Return whether two lists are of the same faults."""
    return len(some) == len(others) and all(one.same(other) for one, other in zip(some, others, strict=True))
