"""What a command needs of the machine's state, and what it is told when it does not have that."""

from __future__ import annotations

from typing import Literal

from mastctl.control.standing import CLOSING, Standing, latched_sentence
from mastctl.control.table import TABLE, Event
from mastctl.errors import MastctlError, NotNow, Unable

Need = Literal["motion", "track", "rest", "idle", "latch"]


def refusal_of(now: Standing, need: Need) -> MastctlError | None:
    """Return why a command that needs something may not be carried out, None if it may.

    Parameters
    ----------
    now
        What the daemon is doing.
    need
        ``motion``: no operation runs, no stop is under way, nothing is latched, the service is not closing.
        ``track``: that, and no track is active. ``rest``: no operation runs and the head does not move.
        ``idle``: no operation runs, and no stop is under way; the head may move, or be latched.
        ``latch``: an emergency stop is latched, and its stop is over.

    Returns
    -------
    refusal
        To be raised: `mastctl.errors.NotNow` ``busy``, ``stopping``, ``estopped``, ``moving`` or
        ``not_estopped``; `mastctl.errors.Unable` ``closing``. A fault refuses nothing: a later move may be
        what clears it, and the head itself refuses what it cannot do.
    """
    event: Event = "reset" if need == "latch" else "operation_began"
    to = TABLE[now.word].get(event)
    if to == "refused: closing":
        return Unable("closing", CLOSING)
    if to == "refused: not_estopped":
        return NotNow("not_estopped", "no emergency stop is latched; there is nothing to reset")
    if to == "refused: stopping":
        return NotNow("stopping", f"{now.reason}; ask again when that is over")
    if to == "refused: estopped" and need not in ("rest", "idle"):
        return NotNow("estopped", latched_sentence(now.latched) if now.latched else now.reason)
    if need == "latch":
        return None
    if now.operation is not None:
        return busy(now.operation)
    if need == "rest" and now.head_moves:
        return NotNow("moving", "the head moves; ask again when it rests")
    if need == "track" and now.track is not None:
        return NotNow("busy", f"track {now.track} runs; stop it before another is started")
    return None


def busy(operation: str) -> NotNow:
    """Return the refusal of what cannot be done beside a running operation."""
    return NotNow("busy", f"operation {operation} is running; wait for it or stop it")
