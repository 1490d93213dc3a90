"""The one machine: who does something tells it here, and reads here what the daemon is doing.

Operations, devices and the tracker keep no state word of their own. What they tell becomes an event of
`mastctl.control.table`; each change of `StateMachine.standing` is published once, in order, as
``("state", "machine", Standing)``.

The lock is held for one change and its publication, which wait for nothing. Reading takes no lock.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from drivers.clock import Clock
from mastctl.control.publisher import Publisher
from mastctl.control.refusals import Need, refusal_of
from mastctl.control.standing import Latched, Residual, Standing, StandingFault, same_faults, why
from mastctl.control.table import CHOICES, TABLE, Event
from mastctl.errors import MastctlError

AFTER_A_STOP = "a stop dropped the goal; the next command starts"

_News = Callable[[Standing], tuple[Event, Standing] | None]


class StateMachine:
    """What the daemon is doing; safe to use from any thread.

    Parameters
    ----------
    clock
        Stamps the changes.
    publisher
        Where they are published; one of its own by default.
    latched
        The causes of the emergency stop that held when the daemon ended: it begins ``stopped`` with any.

    Attributes
    ----------
    publisher
        Where everything else that changes is published too.
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
        now = Standing(since_s=clock.now_s())
        if latched:
            now = replace(now, word="stopped", latched=tuple(latched))
        self._standing = replace(now, reason=why(now))
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
        """Return why a command that needs something may not be carried out now, None if it may.

        As `mastctl.control.refusals.refusal_of`, of this moment.
        """
        return refusal_of(self.standing, need)

    # What is told

    def operation_began(self, operation: str, target: Mapping[str, Any]) -> None:
        """Let an operation begin. Raises what `refusal` returns for ``motion``; then nothing has changed."""
        facts: dict[str, Any] = {"operation": operation, "target": dict(target), "held": ""}
        with self._lock:
            refused = refusal_of(self._standing, "motion")
            if refused is not None:
                raise refused
            self._take(lambda now: ("operation_began", replace(now, **facts)))

    def operation_ended(self, operation: str, residual: Residual | None = None) -> None:
        """Take that an operation ended, and what it measured last; not twice of one."""

        def news(now: Standing) -> tuple[Event, Standing] | None:
            if now.operation != operation:
                return None
            return "operation_ended", replace(now, operation=None, residual=residual or now.residual)

        self._take(news)

    def track_began(self, track: str) -> None:
        """Take that a track began, of which the operation of this id looks first.

        Nothing is refused: its operation was begun, and a stop in between ends the track too.
        """
        self._take(lambda now: ("track_began", replace(now, track=track, held="")))

    def track_ended(self, track: str) -> None:
        """Take that a track ended."""
        self._take(lambda now: ("track_ended", replace(now, track=None)) if now.track == track else None)

    def head_read(self, moving: bool) -> None:
        """Take what a reading of the head says; nothing is done if the one before said the same."""
        now = self._standing
        if now.head_moves != moving or now.word == "starting":
            event: Event = "head_moves" if moving else "head_rests"
            self._take(lambda now: (event, replace(now, head_moves=moving)))

    def head_faults(self, faults: tuple[StandingFault, ...]) -> None:
        """Take all that is wrong with the head now; nothing is done if it is the same as before."""

        def news(now: Standing) -> tuple[Event, Standing] | None:
            if same_faults(now.faults, faults):
                return None
            if faults:
                return "fault_stands", replace(now, faults=faults)
            goes_on = now.operation is not None or now.track is not None
            over = f"it is over: {now.faults[0].message}; the next command starts"
            held = now.held or ("" if goes_on else over)
            return "fault_cleared", replace(now, faults=(), held=held)

        if not same_faults(self._standing.faults, faults):
            self._take(news)

    def stop_asked(self) -> None:
        """Take that a stop was requested; `stop_ended` follows when it is over."""
        self._take(lambda now: ("stop_asked", replace(now, stops=now.stops + 1, held=AFTER_A_STOP)))

    def stop_ended(self) -> None:
        """Take that a stop is over: the head has confirmed it, or its fault was told before."""
        self._take(lambda now: ("stop_ended", replace(now, stops=max(0, now.stops - 1))))

    def estop_asked(self, latched: Callable[[], Sequence[Latched]]) -> None:
        """Take an emergency stop, between `stop_asked` and `stop_ended` of its stop.

        From then on nothing may begin. ``latched`` returns all causes of then; it must not wait.
        """
        self._take(lambda now: ("estop_asked", replace(now, latched=tuple(latched()), held=AFTER_A_STOP)))

    def reset(self, name: str, reason: str, latched: Callable[[], Sequence[Latched]] = tuple) -> None:
        """Take that a latch was released, of a service that called `refusal` of ``latch`` before.

        ``latched`` returns the causes that came since. It must not wait.
        """
        held = f"reset by {name}: {reason}; the next command starts"

        def news(now: Standing) -> tuple[Event, Standing] | None:
            return ("reset", replace(now, latched=tuple(latched()), held=held)) if now.latched else None

        self._take(news)

    def closing(self) -> None:
        """Take that the service is closing: nothing begins any more."""
        self._take(lambda now: ("closing", now))

    def _take(self, news: _News) -> None:
        """Take one event: its facts and the state that the table has for it; publish a change."""
        with self._lock:
            before = self._standing
            if (changed := news(before)) is not None:
                self._change(before, *changed)

    def _change(self, before: Standing, event: Event, now: Standing) -> None:
        to = TABLE[before.word].get(event, before.word)
        if to.startswith("refused: "):  # asked before, and true by now all the same
            to = before.word
        word = CHOICES[to][0](now) if to in CHOICES else to  # type: ignore[index]
        now = replace(now, word=word)  # type: ignore[arg-type]
        if word != before.word:
            now = replace(now, since_s=self._clock.now_s())
        now = replace(now, reason=why(now))
        if now == before:
            return
        self._standing = replace(now, sequence=before.sequence + 1)
        self.publisher.publish("state", "machine", self._standing)
