"""Why the machine is in its state, as one sentence."""

from __future__ import annotations

from mastctl.state.faults import StandingFault
from mastctl.state.standing import Standing, latched_sentence

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
        case "stopped" if now.latch is not None:
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
