"""What the daemon is doing at one moment: one word, why, the facts that it rests on, and what is wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mastctl.answers import EstopHeld, Word


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


@dataclass(frozen=True)
class Residual:
    """The last measured residual, pixels (x, y), with one sigma, and the operation that measured it."""

    residual_px: tuple[float, float]
    residual_sigma_px: tuple[float, float]
    operation: str


@dataclass(frozen=True)
class Latched:
    """One cause of an emergency stop, which holds until a reset.

    Attributes
    ----------
    name, reason
        The client and its reason, as given.
    at
        When, ISO 8601 in UTC: it outlives the clock of this run.
    """

    name: str
    reason: str
    at: str

    def told(self) -> EstopHeld:
        """Return it as JSON."""
        return {"name": self.name, "reason": self.reason, "at": self.at}


def latched_sentence(entries: Sequence[Latched]) -> str:
    """Return the sentence of a latch with all its causes."""
    causes = "; ".join(f"{one.name}: {one.reason}" for one in entries)
    return f"an emergency stop is latched ({causes}); 'mastctl reset' with a reason and a name releases it"


@dataclass(frozen=True)
class Standing:
    """What the daemon is doing at one moment; replaced at each change, never edited.

    Attributes
    ----------
    word
        The state in one word (docs/explanation/safety.md).
    reason
        One sentence that says why; empty where nothing needs to be said.
    since_s
        Since when the word is that, seconds of CLOCK_MONOTONIC.
    sequence
        Grows by one with each change of anything here.
    operation, target
        Id of the running operation, None when none runs; the request that runs, or ran last, as it came.
    residual
        The last one measured.
    track
        Id of the active track, None without one.
    head_moves
        Whether the head's last reading said so.
    stops
        How many stops are under way: the head has not confirmed them, or what ran has not been told yet.
    held
        What ended the last motion before its goal: a stop, a reset, a fault; empty if nothing did, or an
        operation or a track has begun since.
    faults
        What is wrong with the head.
    latched
        The causes of the emergency stop that is latched, the oldest first; empty without one.
    """

    word: Word = "starting"
    reason: str = "the head has not been read yet"
    since_s: float = 0.0
    sequence: int = 0
    operation: str | None = None
    target: Mapping[str, Any] | None = None
    residual: Residual | None = None
    track: str | None = None
    head_moves: bool = False
    stops: int = 0
    held: str = ""
    faults: tuple[StandingFault, ...] = ()
    latched: tuple[Latched, ...] = ()


CLOSING = "the service is closing"


def why(now: Standing) -> str:
    """Return the sentence that says why the word is what it is."""
    match now.word:
        case "starting":
            return "the head has not been read yet"
        case "moving":
            return "the head moves" if now.operation is None else f"operation {now.operation} runs"
        case "tracking":
            return f"track {now.track} is followed"
        case "holding":
            return now.held
        case "stopping":
            return _why_stopping(now)
        case "stopped" if now.latched:
            return "; ".join([latched_sentence(now.latched), *(_told(fault) for fault in now.faults[:1])])
        case "fault" if now.faults:
            more = len(now.faults) - 1
            return _told(now.faults[0]) + (f" (and {more} more)" if more else "")
        case "closing":
            return CLOSING
        case _:
            return ""


def _why_stopping(now: Standing) -> str:
    if now.stops == 0 and now.operation is not None:
        return f"operation {now.operation} is being stopped"
    return "the mast is being stopped"


def _told(fault: StandingFault) -> str:
    return f"{fault.message}, until {fault.until}"
