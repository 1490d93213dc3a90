"""The states of the daemon and what leads from one to the next: this table and nothing beside it.

A row is a state, a column an event. An event that is not in a state's row changes no word there, though the
facts that it tells are kept; some are refused by name instead. Where the next state depends on what else is
true at that moment, the table names one of three choices.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal, get_args

from mastctl.answers import Word
from mastctl.control.standing import Standing

Event = Literal[
    "operation_began",
    "operation_ended",
    "head_moves",
    "head_rests",
    "track_began",
    "track_ended",
    "stop_asked",
    "stop_ended",
    "estop_asked",
    "reset",
    "fault_stands",
    "fault_cleared",
    "closing",
]
Choice = Literal["what goes on", "after a stop", "after a fault"]
Refusal = Literal["refused: stopping", "refused: estopped", "refused: not_estopped", "refused: closing"]
To = Word | Choice | Refusal

WORDS: tuple[Word, ...] = get_args(Word)
EVENTS: tuple[Event, ...] = get_args(Event)

MEANINGS: Mapping[Word, str] = {
    "starting": "the head has not been read yet",
    "ready": "at rest; nothing runs",
    "moving": "an operation runs, or the head moves",
    "tracking": "a track is active",
    "holding": "at rest after a stop, a reset or a fault: the goal was dropped; the next command starts",
    "stopping": "a stop was requested; the head has not confirmed it, or the operation has not ended",
    "stopped": "an emergency stop is latched: nothing moves until a reset, not even after a restart",
    "fault": "the head has a fault; the status has its cause, and the event that clears it",
    "closing": "the daemon ends; it has sent a stop to the head",
}

HAPPENS: Mapping[Event, str] = {
    "operation_began": "an operation was started: a pointing, a look, a jog",
    "operation_ended": "it was done, failed or was stopped",
    "head_moves": "a reading shows that the head moves",
    "head_rests": "a reading shows that it rests; the first reading is one or the other",
    "track_began": "a track was started",
    "track_ended": "it was stopped, or its start found nothing",
    "stop_asked": "a stop was requested; the head gets it before anything else",
    "stop_ended": "the head has confirmed the stop, or has not done so in its time, which is a fault",
    "estop_asked": "an emergency stop was requested: a stop that latches",
    "reset": "an operator released the latch, with name and reason",
    "fault_stands": "a device call of the head failed, or the head reports a fault",
    "fault_cleared": "no fault of the head is left",
    "closing": "the daemon got the signal to end",
}

_ENDS: Mapping[Event, To] = {"stop_asked": "stopping", "estop_asked": "stopping", "closing": "closing"}
_NO_LATCH: Mapping[Event, To] = {"reset": "refused: not_estopped"}

TABLE: Mapping[Word, Mapping[Event, To]] = {
    "starting": {
        **_ENDS,
        **_NO_LATCH,
        "operation_began": "moving",
        "track_began": "tracking",
        "head_moves": "moving",
        "head_rests": "ready",
        "fault_stands": "fault",
    },
    "ready": {
        **_ENDS,
        **_NO_LATCH,
        "operation_began": "moving",
        "track_began": "tracking",
        "head_moves": "moving",
        "fault_stands": "fault",
    },
    "moving": {
        **_ENDS,
        **_NO_LATCH,
        "operation_ended": "what goes on",
        "track_began": "tracking",
        "head_rests": "what goes on",
        "fault_stands": "fault",
    },
    "tracking": {
        **_ENDS,
        **_NO_LATCH,
        "track_ended": "what goes on",
        "fault_stands": "fault",
    },
    "holding": {
        **_ENDS,
        **_NO_LATCH,
        "operation_began": "moving",
        "track_began": "tracking",
        "head_moves": "moving",
        "fault_stands": "fault",
    },
    "stopping": {
        "operation_began": "refused: stopping",
        "reset": "refused: stopping",
        "operation_ended": "after a stop",
        "stop_ended": "after a stop",
        "closing": "closing",
    },
    "stopped": {
        "operation_began": "refused: estopped",
        "reset": "after a stop",
        "closing": "closing",
    },
    "fault": {
        **_ENDS,
        **_NO_LATCH,
        "fault_cleared": "after a fault",
    },
    "closing": {
        "operation_began": "refused: closing",
        "reset": "refused: closing",
    },
}


def what_goes_on(now: Standing) -> Word:
    """Return the state of a free head: tracking, moving, holding or ready."""
    if now.track is not None:
        return "tracking"
    if now.operation is not None or now.head_moves:
        return "moving"
    return "holding" if now.held else "ready"


def after_a_stop(now: Standing) -> Word:
    """Return the state when a part of a stop is done, or the latch released: stopping until all is done."""
    if now.stops or now.operation is not None:
        return "stopping"
    if now.latched:
        return "stopped"
    return "fault" if now.faults else "holding"


def after_a_fault(now: Standing) -> Word:
    """Return the state when the head is well again: holding, unless something went on all the same."""
    return "holding" if now.track is None and now.operation is None else what_goes_on(now)


CHOICES: Mapping[Choice, tuple[Callable[[Standing], Word], tuple[Word, ...]]] = {
    "what goes on": (what_goes_on, ("tracking", "moving", "holding", "ready")),
    "after a stop": (after_a_stop, ("stopping", "stopped", "fault", "holding")),
    "after a fault": (after_a_fault, ("tracking", "moving", "holding")),
}


def leads_to(word: Word, event: Event) -> tuple[Word, ...]:
    """Return every state that an event may lead to from a state; the same one where it changes no word."""
    to = TABLE[word].get(event, word)
    if to in CHOICES:
        return CHOICES[to][1]  # type: ignore[index]
    return (word,) if to.startswith("refused: ") else (to,)  # type: ignore[return-value]
