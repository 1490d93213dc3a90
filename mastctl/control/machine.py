"""What the daemon is doing: the facts, and the state and the reason that follow from them.

Operations, devices and the tracker report the facts to the one `StateMachine`, and the daemon's state is read
from it. Each change is published once, in order, as ``("state", "machine", Standing)``. The publisher's lock
is kept for one change and its publication, which wait for nothing. Reading takes no lock.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from drivers.clock import Clock
from mastctl.answers import FaultAnswer, LastResidual, ServiceState, StateAnswer, StateFacts
from mastctl.as_json import as_json
from mastctl.control.publisher import Publisher
from mastctl.errors import MastctlError, NotNow, Unable


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

    def as_json(self, now_s: float) -> FaultAnswer:
        """Return it as JSON at a moment."""
        return {
            "device": self.device,
            "code": self.code,
            "message": self.message,
            "until": self.until,
            "for_s": max(0.0, now_s - self.since_s),
        }

    @property
    def sentence(self) -> str:
        """What is wrong, and until when."""
        return f"{self.message}, until {self.until}"


def same_faults(some: tuple[StandingFault, ...], others: tuple[StandingFault, ...]) -> bool:
    """Return whether two lists are of the same faults: their messages or their times may have gone on."""
    return len(some) == len(others) and all(
        (one.device, one.code) == (other.device, other.code)
        and (one.since_s == other.since_s or one.message == other.message)
        for one, other in zip(some, others, strict=True)
    )


@dataclass(frozen=True)
class Latched:
    """One cause of an emergency stop, which lasts until a reset: the client and its reason, as given.

    ``at`` is ISO 8601 in UTC: it outlives the clock of this run.
    """

    name: str
    reason: str
    at: str


def latched_sentence(entries: Sequence[Latched]) -> str:
    """Return the sentence of a latch with all its causes."""
    causes = "; ".join(f"{one.name}: {one.reason}" for one in entries)
    return f"an emergency stop is latched ({causes}); 'mastctl reset' with a reason and a name releases it"


CLOSING = "the service is closing"
AFTER_A_STOP = "a stop dropped the goal; the next command starts"

Need = Literal["motion", "track", "rest", "idle", "latch"]
"""What a command may need of the present state.

``motion``: no operation runs, no stop is under way, nothing is latched, the service is not closing.
``track``: that, and no track is active. ``rest``: no operation runs and the head does not move. ``idle``: no
operation runs, and no stop is under way; the head may move, or be latched. ``latch``: an emergency stop is
latched, and its stop is over.
"""


@dataclass(frozen=True)
class Standing:
    """What the daemon is doing at one moment; replaced at each change, never edited.

    ``since_s``: of the state, seconds of CLOCK_MONOTONIC. ``target``: the request that runs, or ran last.
    ``head_moves``: of the last reading, None before the first; ``coasts``: it moved when a stop was
    requested, and was not read at rest since. ``stops``: under way, not confirmed by the head; ``stopping``:
    one is, or the operation that it stopped has not ended. ``dropped``: what ended the last motion before its
    goal (a stop, a reset, a fault); empty if nothing did, or an operation or a track has begun since.
    ``faults`` are the head's; ``latched`` are the causes of an emergency stop, the oldest first.
    """

    since_s: float = 0.0
    operation: str | None = None
    target: Mapping[str, Any] | None = None
    residual: LastResidual | None = None
    track: str | None = None
    head_moves: bool | None = None
    coasts: bool = False
    stops: int = 0
    stopping: bool = False
    dropped: str = ""
    faults: tuple[StandingFault, ...] = ()
    latched: tuple[Latched, ...] = ()
    closing: bool = False

    @property
    def state(self) -> ServiceState:
        """The first that is true of those that `reason` explains."""
        return self._judged()[0]

    @property
    def reason(self) -> str:
        """One sentence that says why the state is what it is; empty where nothing needs to be said."""
        return self._judged()[1]

    def _judged(self) -> tuple[ServiceState, str]:
        if self.closing:
            return "closing", CLOSING
        if self.stopping:
            what = "the mast" if self.stops else f"operation {self.operation}"
            return "stopping", f"{what} is being stopped"
        if self.latched:
            sentences = [latched_sentence(self.latched), *(one.sentence for one in self.faults[:1])]
            return "stopped", "; ".join(sentences)
        if self.faults:
            more = len(self.faults) - 1
            return "fault", self.faults[0].sentence + (f" (and {more} more)" if more else "")
        if self.track is not None:
            return "tracking", f"track {self.track} is followed"
        if self.operation is not None:
            return "moving", f"operation {self.operation} runs"
        if self.head_moves and not self.coasts:
            return "moving", "the head moves"
        if self.dropped:
            return "holding", self.dropped
        if self.head_moves is None:
            return "starting", "the head has not been read yet"
        return "ready", ""

    def refusal(self, need: Need) -> MastctlError | None:
        """Return the refusal of a command that needs something, None if there is none.

        It is NotNow ``busy``, ``stopping``, ``estopped``, ``moving`` or ``not_estopped``, Unable ``closing``.
        A fault refuses nothing: a later move may clear it, and the head itself refuses what it cannot do.
        """
        if self.closing:
            return Unable("closing", CLOSING)
        if self.stopping:
            return NotNow("stopping", f"{self.reason}; try again when that is over")
        if need == "latch":
            message = "no emergency stop is latched; there is nothing to reset"
            return None if self.latched else NotNow("not_estopped", message)
        if self.latched and need not in ("rest", "idle"):
            return NotNow("estopped", latched_sentence(self.latched))
        if self.operation is not None:
            return busy(self.operation)
        if need == "rest" and self.head_moves:
            return NotNow("moving", "the head moves; try again when it rests")
        if need == "track" and self.track is not None:
            return NotNow("busy", f"track {self.track} runs; stop it before another is started")
        return None

    def as_json(self, now_s: float) -> StateAnswer:
        """Return it as JSON at a moment, as events have it."""
        return {**self.summary(now_s), "track": self.track, "moving": bool(self.head_moves)}

    def summary(self, now_s: float) -> StateFacts:
        """Return the same without the track and whether the head moves."""
        state, reason = self._judged()
        return {
            "state": state,
            "reason": reason,
            "state_for_s": max(0.0, now_s - self.since_s),
            "estop": as_json(self.latched[0]) if self.latched else None,
            "estops": as_json(self.latched),
            "operation": self.operation,
            "target": as_json(self.target),
            "last_residual": self.residual,
        }


def busy(operation: str) -> NotNow:
    """Return the refusal of what cannot be done beside a running operation."""
    return NotNow("busy", f"operation {operation} is running; wait for it or stop it")


class StateMachine:
    """What the daemon is doing; safe to use from any thread.

    ``latched`` are the causes of an emergency stop that was latched when the daemon ended: it begins
    ``stopped`` with any. Everything else that changes is published by ``publisher`` too.
    """

    def __init__(
        self, clock: Clock, publisher: Publisher | None = None, latched: Sequence[Latched] = ()
    ) -> None:
        self.publisher = publisher or Publisher()
        self._clock = clock
        self._standing = Standing(since_s=clock.now_s(), latched=tuple(latched))
        self.publisher.publish("state", "machine", self._standing)

    @property
    def standing(self) -> Standing:
        """What it is doing now."""
        return self._standing

    def something_runs(self) -> bool:
        """Return whether an operation or a track runs. Takes no lock."""
        now = self.standing
        return now.operation is not None or now.track is not None

    def operation_began(self, operation: str, target: Mapping[str, Any]) -> None:
        """Let an operation begin. Raises the refusal of ``motion``; then nothing has changed."""

        def begin(now: Standing) -> Standing:
            if (refused := now.refusal("motion")) is not None:
                raise refused
            return replace(now, operation=operation, target=dict(target), dropped="")

        self._change(begin)

    def operation_ended(self, residual: LastResidual | None = None) -> None:
        """Note that the operation ended, and what it measured last."""
        self._change(lambda now: replace(now, operation=None, residual=residual or now.residual))

    def follow(self, track: str | None) -> None:
        """Note which track is active, by the id of the operation that began it; a stop ends it too."""
        self._change(lambda now: replace(now, track=track, dropped="" if track else now.dropped))

    def head_read(self, moving: bool) -> None:
        """Note whether the head moves."""
        if self._standing.head_moves is not moving:
            self._change(lambda now: replace(now, head_moves=moving, coasts=now.coasts and moving))

    def head_faults(self, faults: tuple[StandingFault, ...]) -> None:
        """Note all that is wrong with the head now."""

        def change(now: Standing) -> Standing:
            dropped = now.dropped
            free = not (now.operation or now.track or now.stops) and dropped in ("", AFTER_A_STOP)
            if now.faults and not faults and free:  # the head came to rest by itself if the stop failed
                dropped = f"it is over: {now.faults[0].message}; the next command starts"
            return replace(now, faults=faults, dropped=dropped)

        self._change(change)

    def stop_requested(self) -> None:
        """Note that a stop was requested; `stop_ended` follows when it is over."""

        def change(now: Standing) -> Standing:
            stopping, coasts = now.stopping or not now.latched, bool(now.head_moves)
            return replace(now, stops=now.stops + 1, stopping=stopping, coasts=coasts, dropped=AFTER_A_STOP)

        self._change(change)

    def stop_ended(self) -> None:
        """Note that a stop is over: the head has confirmed it, or its fault was reported before."""
        self._change(lambda now: replace(now, stops=max(0, now.stops - 1)))

    def estop_requested(self, latched: Callable[[], Sequence[Latched]]) -> None:
        """Note an emergency stop: from then on nothing may begin.

        ``latched`` returns all causes of then, without waiting.
        """
        self._change(lambda now: replace(now, latched=tuple(latched()), dropped=AFTER_A_STOP))

    def reset(self, name: str, reason: str, latched: Callable[[], Sequence[Latched]] = tuple) -> None:
        """Note that a latch was released; ``latched`` returns the causes that came since, without waiting."""
        dropped = f"reset by {name}: {reason}; the next command starts"
        self._change(lambda now: replace(now, latched=tuple(latched()), dropped=dropped))

    def closing(self) -> None:
        """Note that the service is closing: nothing begins any more."""
        self._change(lambda now: replace(now, closing=True))

    def _change(self, change: Callable[[Standing], Standing]) -> None:
        """Take other facts; publish a change."""
        with self.publisher.lock:
            before = self._standing
            now = change(before)
            if now.stopping and now.stops == 0 and now.operation is None:
                now = replace(now, stopping=False)
            if now == before:
                return
            since_s = before.since_s if now.state == before.state else self._clock.now_s()
            self._standing = replace(now, since_s=since_s)
            self.publisher.publish("state", "machine", self._standing)
