"""The one machine: operations, devices and the tracker report here, and the daemon's state is read here.

What they report are the facts of `mastctl.control.standing.Standing`, from which its state follows. Each
change is published once, in order, as ``("state", "machine", Standing)``. The lock is kept for one change and
its publication, which wait for nothing. Reading takes no lock.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

from drivers.clock import Clock
from mastctl.control.publisher import Publisher
from mastctl.control.standing import (
    CLOSING,
    Latched,
    Residual,
    Standing,
    StandingFault,
    latched_sentence,
    same_faults,
)
from mastctl.errors import MastctlError, NotNow, Unable

Need = Literal["motion", "track", "rest", "idle", "latch"]


def refusal_of(now: Standing, need: Need) -> MastctlError | None:
    """Return the refusal of a command that needs something of the present state, None if there is none.

    ``motion``: no operation runs, no stop is under way, nothing is latched, the service is not closing.
    ``track``: that, and no track is active. ``rest``: no operation runs and the head does not move. ``idle``:
    no operation runs, and no stop is under way; the head may move, or be latched. ``latch``: an emergency
    stop is latched, and its stop is over.

    It is NotNow ``busy``, ``stopping``, ``estopped``, ``moving`` or ``not_estopped``, Unable ``closing``. A
    fault refuses nothing: a later move may clear it, and the head itself refuses what it cannot do.
    """
    if now.closing:
        return Unable("closing", CLOSING)
    if now.stopping:
        return NotNow("stopping", f"{now.reason}; try again when that is over")
    if need == "latch":
        message = "no emergency stop is latched; there is nothing to reset"
        return None if now.latched else NotNow("not_estopped", message)
    if now.latched and need not in ("rest", "idle"):
        return NotNow("estopped", latched_sentence(now.latched))
    if now.operation is not None:
        return busy(now.operation)
    if need == "rest" and now.head_moves:
        return NotNow("moving", "the head moves; try again when it rests")
    if need == "track" and now.track is not None:
        return NotNow("busy", f"track {now.track} runs; stop it before another is started")
    return None


def busy(operation: str) -> NotNow:
    """Return the refusal of what cannot be done beside a running operation."""
    return NotNow("busy", f"operation {operation} is running; wait for it or stop it")


AFTER_A_STOP = "a stop dropped the goal; the next command starts"

_Change = Callable[[Standing], Standing]


class StateMachine:
    """What the daemon is doing; safe to use from any thread.

    ``latched`` are the causes of an emergency stop that was latched when the daemon ended: it begins
    ``stopped`` with any. Everything else that changes is published by ``publisher`` too.
    """

    def __init__(
        self,
        clock: Clock,
        publisher: Publisher | None = None,
        latched: Sequence[Latched] = (),
    ) -> None:
        self.publisher = publisher or Publisher()
        self._clock = clock
        self._lock = threading.RLock()
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

    def refusal(self, need: Need) -> MastctlError | None:
        """Return the refusal of a command that needs something, as `refusal_of`, of this moment."""
        return refusal_of(self.standing, need)

    def operation_began(self, operation: str, target: Mapping[str, Any]) -> None:
        """Let an operation begin. Raises what `refusal` returns for ``motion``; then nothing has changed."""
        facts: dict[str, Any] = {"operation": operation, "target": dict(target), "held": ""}
        with self._lock:
            refused = refusal_of(self._standing, "motion")
            if refused is not None:
                raise refused
            self._change(lambda now: replace(now, **facts))

    def operation_ended(self, operation: str, residual: Residual | None = None) -> None:
        """Note that an operation ended, and what it measured last; not twice of one."""
        self._change(
            lambda now: (
                replace(now, operation=None, residual=residual or now.residual)
                if now.operation == operation
                else now
            )
        )

    def track_began(self, track: str) -> None:
        """Note that a track began, of which the operation of this id looks first.

        Nothing is refused: its operation was begun, and a stop in between ends the track too.
        """
        self._change(lambda now: replace(now, track=track, held=""))

    def track_ended(self, track: str) -> None:
        """Note that a track ended."""
        self._change(lambda now: replace(now, track=None) if now.track == track else now)

    def head_read(self, moving: bool) -> None:
        """Note what a reading of the head says; nothing is done if the one before said the same."""
        if self._standing.head_moves is not moving:
            self._change(lambda now: replace(now, head_moves=moving, coasts=now.coasts and moving))

    def head_faults(self, faults: tuple[StandingFault, ...]) -> None:
        """Note all that is wrong with the head now; nothing is done if it is the same as before."""

        def change(now: Standing) -> Standing:
            if same_faults(now.faults, faults):
                return now
            held = now.held
            if not faults and now.operation is None and now.track is None:
                held = held or f"it is over: {now.faults[0].message}; the next command starts"
            return replace(now, faults=faults, held=held)

        if not same_faults(self._standing.faults, faults):
            self._change(change)

    def stop_requested(self) -> None:
        """Note that a stop was requested; `stop_ended` follows when it is over."""
        self._change(
            lambda now: replace(
                now,
                stops=now.stops + 1,
                stopping=now.stopping or not now.latched,
                coasts=bool(now.head_moves),
                held=AFTER_A_STOP,
            )
        )

    def stop_ended(self) -> None:
        """Note that a stop is over: the head has confirmed it, or its fault was reported before."""
        self._change(lambda now: replace(now, stops=max(0, now.stops - 1)))

    def estop_requested(self, latched: Callable[[], Sequence[Latched]]) -> None:
        """Note an emergency stop, between `stop_requested` and `stop_ended` of its stop.

        From then on nothing may begin. ``latched`` returns all causes of then; it must not wait.
        """
        self._change(lambda now: replace(now, latched=tuple(latched()), held=AFTER_A_STOP))

    def reset(self, name: str, reason: str, latched: Callable[[], Sequence[Latched]] = tuple) -> None:
        """Note that a latch was released, of a service that called `refusal` of ``latch`` before.

        ``latched`` returns the causes that came since. It must not wait.
        """
        held = f"reset by {name}: {reason}; the next command starts"
        self._change(lambda now: replace(now, latched=tuple(latched()), held=held) if now.latched else now)

    def closing(self) -> None:
        """Note that the service is closing: nothing begins any more."""
        self._change(lambda now: replace(now, closing=True))

    def _change(self, change: _Change) -> None:
        """Take other facts; publish a change."""
        with self._lock:
            before = self._standing
            now = change(before)
            if now.stopping and now.stops == 0 and now.operation is None:
                now = replace(now, stopping=False)
            if now == before:
                return
            since_s = before.since_s if now.state == before.state else self._clock.now_s()
            self._standing = replace(now, since_s=since_s, sequence=before.sequence + 1)
            self.publisher.publish("state", "machine", self._standing)
