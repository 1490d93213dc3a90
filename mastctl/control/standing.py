"""What the daemon is doing at one moment: the facts, and the state and the reason that follow from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mastctl.answers import EstopHeld, Word


@dataclass(frozen=True)
class StandingFault:
    """Something wrong with a device since a moment of CLOCK_MONOTONIC.

    ``until`` is what takes it back: a phrase that follows "until".
    """

    device: str
    code: str
    message: str
    since_s: float
    until: str

    def same(self, other: StandingFault) -> bool:
        """Return whether both are one fault at two moments: its message or its time may have gone on."""
        return (self.device, self.code) == (other.device, other.code) and (
            self.since_s == other.since_s or self.message == other.message
        )


def same_faults(some: tuple[StandingFault, ...], others: tuple[StandingFault, ...]) -> bool:
    """Return whether two lists are of the same faults."""
    return len(some) == len(others) and all(one.same(other) for one, other in zip(some, others, strict=True))


@dataclass(frozen=True)
class Residual:
    """The last measured residual, pixels (x, y), with one sigma, and the operation that measured it."""

    residual_px: tuple[float, float]
    residual_sigma_px: tuple[float, float]
    operation: str


@dataclass(frozen=True)
class Latched:
    """One cause of an emergency stop, which lasts until a reset: the client and its reason, as given.

    ``at`` is ISO 8601 in UTC: it outlives the clock of this run.
    """

    name: str
    reason: str
    at: str

    def as_json(self) -> EstopHeld:
        """Return it as JSON."""
        return {"name": self.name, "reason": self.reason, "at": self.at}


def latched_sentence(entries: Sequence[Latched]) -> str:
    """Return the sentence of a latch with all its causes."""
    causes = "; ".join(f"{one.name}: {one.reason}" for one in entries)
    return f"an emergency stop is latched ({causes}); 'mastctl reset' with a reason and a name releases it"


CLOSING = "the service is closing"

MEANINGS: Mapping[Word, str] = {
    "closing": "the daemon ends; it has sent a stop to the head",
    "stopping": "a stop was requested; the head has not confirmed it, or the operation has not ended",
    "stopped": "an emergency stop is latched: nothing moves until a reset, not even after a restart",
    "fault": "the head has a fault; the status has its cause, and the event that clears it",
    "tracking": "a track is active",
    "moving": "an operation runs, or the head moves",
    "holding": "at rest after a stop, a reset or a fault: the goal was dropped; the next command starts",
    "starting": "the head has not been read yet",
    "ready": "at rest; nothing runs",
}
"""The states: of several that are true the first one in this order counts."""


@dataclass(frozen=True)
class Standing:
    """What the daemon is doing at one moment; replaced at each change, never edited.

    Attributes
    ----------
    since_s
        Since when the state is that, seconds of CLOCK_MONOTONIC.
    sequence
        Grows by one with each change of anything in it.
    operation, target
        Id of the running operation, None when none runs; the request that runs, or ran last, as it came.
    head_moves
        Whether the head's last reading said so; None before the first.
    coasts
        Whether it moved when a stop was requested, and was not read at rest since.
    stops
        How many stops are under way, which the head has not confirmed.
    stopping
        Whether one is, or what it stopped has not ended yet.
    held
        What ended the last motion before its goal: a stop, a reset, a fault; empty if nothing did, or an
        operation or a track has begun since.
    faults
        Of the head.
    latched
        The causes of the emergency stop that is latched, the oldest first; empty without one.
    """

    since_s: float = 0.0
    sequence: int = 0
    operation: str | None = None
    target: Mapping[str, Any] | None = None
    residual: Residual | None = None
    track: str | None = None
    head_moves: bool | None = None
    coasts: bool = False
    stops: int = 0
    stopping: bool = False
    held: str = ""
    faults: tuple[StandingFault, ...] = ()
    latched: tuple[Latched, ...] = ()
    closing: bool = False

    @property
    def state(self) -> Word:
        """The first of `MEANINGS` that is true."""
        true: Mapping[Word, object] = {
            "closing": self.closing,
            "stopping": self.stopping,
            "stopped": self.latched,
            "fault": self.faults,
            "tracking": self.track is not None,
            "moving": self.operation is not None or (self.head_moves and not self.coasts),
            "holding": self.held,
            "starting": self.head_moves is None,
            "ready": True,
        }
        return next(state for state in MEANINGS if true[state])

    @property
    def reason(self) -> str:
        """One sentence that says why the state is what it is; empty where nothing needs to be said."""
        match self.state:
            case "closing":
                return CLOSING
            case "stopping" if self.stops == 0:
                return f"operation {self.operation} is being stopped"
            case "stopping":
                return "the mast is being stopped"
            case "stopped":
                return "; ".join([latched_sentence(self.latched), *map(_sentence, self.faults[:1])])
            case "fault":
                more = len(self.faults) - 1
                return _sentence(self.faults[0]) + (f" (and {more} more)" if more else "")
            case "tracking":
                return f"track {self.track} is followed"
            case "moving":
                return "the head moves" if self.operation is None else f"operation {self.operation} runs"
            case "holding":
                return self.held
            case "starting":
                return MEANINGS["starting"]
            case _:
                return ""


def _sentence(fault: StandingFault) -> str:
    return f"{fault.message}, until {fault.until}"
