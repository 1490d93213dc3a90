"""Who steers: one lease at a time, or without one, whoever started what runs.

A lease runs on the machine's clock, however fast a simulated rover's goes: it bounds how long a client may
be silent, and clients live in real time. It holds while the time is before its end, not at its end. Its id
is what proves it, so no answer but the holder's own tells it.

Reading from here (`LeaseTable.control`) takes no lock.
"""

from __future__ import annotations

import contextlib
import hmac
import logging
import math
import secrets
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from typing import Literal

from drivers.clock import Clock
from mastctl.answers import ControlTold, LeaseRuns
from mastctl.control.caller import Caller
from mastctl.errors import BadRequest, NotNow

log = logging.getLogger(__name__)

SHORTEST_S, USUAL_S, LONGEST_S = 1.0, 30.0, 3600.0
NOT_RENEWED = "the lease was not renewed for"
SILENT_S = 0.2  # how soon after its time what runs under a lease that stops it is stopped, at most
AGAIN_S = 1.0  # between such stops while the head does not confirm one
REMEMBERED = 64  # ended leases whose end is still told to who comes with them


class Leased(NotNow):
    """Another client steers; ``detail`` has its name, and for how long."""

    def __init__(self, control: WhoSteers, now_s: float) -> None:
        self.detail = control.told(now_s)
        super().__init__("leased", f"{control.sentence(now_s)}; wait, or take over with a reason")


class LeaseOver(NotNow):
    """A lease has ended; ``detail`` has ``how``."""

    def __init__(self, how: str) -> None:
        self.detail = {"how": how}
        super().__init__("lease_over", f"the lease has ended: {how}; acquire another")


@dataclass(frozen=True, eq=False)
class StopCame:
    """A stop that came; ``how`` tells which, and by whom."""

    how: str = "the head was stopped"


@dataclass(frozen=True)
class Lease:
    """The right to steer until ``until_s``, seconds of the lease's clock.

    A ``preemptible`` one ends as soon as another client wants to steer, or stops the head.
    ``last_stop`` is that of `LeaseTable.last_stop` after which the next one ends it; None: no stop does.
    ``credential`` is what its caller showed, without which it ends; empty: nothing. One that
    ``stops_when_silent`` takes what runs with it when its time runs out.
    """

    id: str
    holder: str
    since_s: float
    for_s: float
    until_s: float
    preemptible: bool = False
    last_stop: StopCame | None = None
    credential: str = field(default="", repr=False)
    stops_when_silent: bool = False
    caller: str = ""


@dataclass(frozen=True)
class WhoSteers:
    """Who steers.

    Attributes
    ----------
    holder
        Its name.
    kind
        ``lease``, or ``operation``: by what runs, until that has ended.
    until_s
        When a lease ends, seconds of its clock; None for an operation.
    """

    holder: str
    kind: Literal["lease", "operation"]
    until_s: float | None = None

    def told(self, now_s: float) -> ControlTold:
        """Return it as JSON: what is left in seconds, and when that is by the wall clock (UTC)."""
        left_s = None if self.until_s is None else max(0.0, self.until_s - now_s)
        until = None if left_s is None else _by_the_wall(left_s)
        return {"holder": self.holder, "kind": self.kind, "for_s": left_s, "until": until}

    def sentence(self, now_s: float) -> str:
        """Return it in plain words."""
        if self.until_s is None:
            return f"{self.holder} steers, until what runs has ended"
        return f"{self.holder} steers, for {max(0.0, self.until_s - now_s):.1f} s more"


class LeaseTable:
    """The lease of one daemon, and who steers without one; safe to use from any thread.

    Parameters
    ----------
    clock
        What leases run on.
    running
        Whether an operation or a track runs; called with the lock held, so it must take none.
    on_change
        Told who steers after each change, and that a lease has ended by time when somebody asks next.
    give_way
        Stops what runs under a lease that gives way, before who came for it goes on; gets why. Called
        without the lock.

    Attributes
    ----------
    stands
        Whether a credential still lets in; called with the lock held, from any thread.
    """

    def __init__(
        self,
        clock: Clock,
        running: Callable[[], bool],
        on_change: Callable[[WhoSteers | None], None] = lambda control: None,
        give_way: Callable[[str], object] = lambda why: None,
    ) -> None:
        self._clock = clock
        self._running = running
        self._on_change = on_change
        self._give_way = give_way
        self.stands: Callable[[str], bool] = lambda credential: True
        self._last_stop = StopCame()
        self._lock = threading.Lock()
        self._lease: Lease | None = None
        self._over: dict[str, str] = {}  # id of an ended lease: how it ended
        self._under_way: dict[object, str] = {}  # commands that are being carried out: their party
        self._party: str | None = None  # who started what runs
        self._closed = False

    def control(self) -> WhoSteers | None:
        """Return who steers now, None for nobody."""
        lease = self._lease
        if lease is not None and not self._over_by(lease):
            return WhoSteers(lease.holder, "lease", lease.until_s)
        under_way = next(iter(tuple(self._under_way.values())), None)
        party = under_way or (self._party if self._running() else None)
        return None if party is None else WhoSteers(party, "operation")

    def told(self) -> ControlTold | None:
        """Return who steers as ``GET /status`` tells it."""
        control = self.control()
        return None if control is None else control.told(self._clock.now_s())

    def told_of(self, lease: Lease) -> LeaseRuns:
        """Return a lease as its holder is told of it, whoever steers meanwhile."""
        left_s = max(0.0, lease.until_s - self._clock.now_s())
        return {"holder": lease.holder, "for_s": left_s, "until": _by_the_wall(left_s)}

    @property
    def last_stop(self) -> StopCame:
        """The last stop; another object as soon as another one comes. Takes no lock."""
        return self._last_stop

    def stop_came(self, how: str = "the head was stopped") -> None:
        """End a lease that ends with a stop: somebody stops the head. Takes no lock, waits for nothing."""
        self._last_stop = StopCame(how)

    def was_stopped(self, lease: Lease) -> bool:
        """Return whether a stop has come that ends a lease; takes no lock."""
        return lease.last_stop is not None and lease.last_stop is not self._last_stop

    def acquire(
        self,
        caller: Caller,
        name: str | None = None,
        for_s: float = USUAL_S,
        preemptible: bool = False,
        ends_with_stop: bool = False,
        stops_when_silent: bool = False,
    ) -> Lease:
        """Return a new lease if nobody else steers, or who does gives way.

        Parameters
        ----------
        caller
            Who asks. What its name has running does not stand against it.
        name
            The holder's name, the caller's by default.
        for_s
            How long, seconds.
        preemptible
            Whether it ends as soon as anybody else wants to steer, or stops the head.
        ends_with_stop
            Whether it ends as soon as anybody stops the head, and for that alone.
        stops_when_silent
            Whether what runs is stopped when its time runs out: its holder has died, or is out of reach.

        Raises
        ------
        Leased
            If somebody steers.
        BadRequest
            If ``for_s`` is out of bounds.
        DriverError
            If what runs under a lease that gives way could not be stopped; there is no new lease then.
        """
        _check_time(for_s)
        with self._changing():
            why = self._check_free(caller)
            last_stop = self._last_stop if preemptible or ends_with_stop else None
            lease = self._grant(caller, name, for_s, preemptible, last_stop, stops_when_silent)
        return self._begun(lease, why)

    def _begun(self, lease: Lease, why: str) -> Lease:
        """Return a new lease when what gives way to it was stopped.

        If that fails the lease ends: its id is told to no client.
        """
        try:
            if lease.stops_when_silent:
                threading.Thread(target=self._watch, args=(lease,), name="silent holder", daemon=True).start()
            if why:
                self._give_way(why)
        except BaseException:
            with self._changing():
                if self._lease is not None and self._lease.id == lease.id:
                    self._end("it could not be granted")
            raise
        return lease

    def _watch(self, lease: Lease) -> None:
        """Stop what a lease's holder has left running, again and again until the head confirms it, unless
        another client steers by then."""
        try:
            while not self.stopped_silent(lease):
                self._clock.sleep(SILENT_S)
            return
        except Exception as error:
            log.error("what %s has left running: %s; the stop is sent again", lease.holder, error)
        why = self._silence(lease)
        names = lease.holder, lease.caller
        while not self._closed and ((now := self.control()) is None or now.holder in names):
            self._clock.sleep(AGAIN_S)
            with contextlib.suppress(Exception):
                self._give_way(why)
                log.warning("the head has confirmed the stop: %s", why)
                return

    def stopped_silent(self, lease: Lease) -> bool:
        """Return whether a lease has ended; what its holder began is stopped if its time ran out."""
        with self._changing():
            if self._lease is not None and self._lease.id == lease.id:
                return False
            its_own = self._lease is None and self._party in (lease.holder, lease.caller)
            why = self._silence(lease)
        if why and its_own and self._running():
            self._give_way(why)
        return True

    def _silence(self, lease: Lease) -> str:
        """Why what runs under a lease is stopped; empty unless its time ran out."""
        how = self._over.get(lease.id, "")
        return f"{lease.holder} began it and has fallen silent: {how}" if how.startswith(NOT_RENEWED) else ""

    def close(self) -> None:
        """Send no stop for a silent holder any more: the service has stopped the head, and ends."""
        self._closed = True

    def holds(self, lease_id: str) -> bool:
        """Return whether a lease runs now; takes no lock."""
        lease = self._lease
        return lease is not None and lease.id == lease_id and not self._over_by(lease)

    def check(self, lease_id: str) -> None:
        """Pass a lease that runs now. Raises NotNow as `renew`."""
        with self._changing():
            self._held_by(lease_id)

    def renew(self, lease_id: str, for_s: float | None = None) -> Lease:
        """Have a lease run for ``for_s`` seconds from now on, by default as long as at first; return it.

        Raises
        ------
        NotNow
            ``lease_over`` with how it ended, ``lease_unknown``.
        BadRequest
            If ``for_s`` is out of bounds.
        """
        if for_s is not None:
            _check_time(for_s)
        with self._changing():
            lease = self._held_by(lease_id)
            for_s = lease.for_s if for_s is None else for_s
            self._lease = replace(lease, for_s=for_s, until_s=self._clock.now_s() + for_s)
            return self._lease

    def release(self, lease_id: str) -> None:
        """End a lease. Raises NotNow as `renew`."""
        with self._changing():
            self._held_by(lease_id)
            self._end("it was released")

    def take(
        self,
        caller: Caller,
        reason: str,
        name: str | None = None,
        for_s: float = USUAL_S,
        last_stop: StopCame | None = None,
        preemptible: bool = False,
        ends_with_stop: bool = False,
        stops_when_silent: bool = False,
    ) -> Lease:
        """Return a new lease, whoever steers; the former holder is told by whom it was taken, and why.

        What runs goes on, but for what runs under a lease that gives way. With ``last_stop`` it ends with the
        first stop after that one. Other parameters and exceptions as of `acquire`.
        """
        _check_time(for_s)
        with self._changing():
            gave_way = self._lease is not None and self._lease.preemptible and self._running()
            how = f"{name or caller.name} took over: {reason}"
            self._end(how)
            if last_stop is None and (preemptible or ends_with_stop):
                last_stop = self._last_stop
            lease = self._grant(caller, name, for_s, preemptible, last_stop, stops_when_silent)
        return self._begun(lease, how if gave_way else "")

    @contextmanager
    def steering(self, caller: Caller, lease_id: str | None) -> Iterator[None]:
        """Let a command that steers be carried out inside the block; waits for nobody.

        Until it has ended, and what it started too, nobody else gets a lease or steers, unless by `take`.

        Raises
        ------
        Leased
            If somebody else steers.
        NotNow
            ``lease_over``, ``lease_unknown``, for the lease that came with it.
        DriverError
            If what runs under a lease that gives way could not be stopped.
        """
        ticket, why = object(), ""
        with self._changing():
            if lease_id is not None:
                party = self._held_by(lease_id).holder
            else:
                why = self._check_free(caller)
                party = caller.name
            self._under_way[ticket] = party
            anothers = self._running()
        try:
            if why:
                self._give_way(why)
            yield
            anothers = False  # it was carried out: what runs from now on is its
        finally:
            with self._changing():
                if not anothers:
                    self._party = party
                del self._under_way[ticket]

    # With the lock held

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """Hold the lock, with a lease that has run out ended; tell a change after it."""
        changed = False
        try:
            with self._lock:
                before = self._lease
                over = "" if before is None else self._over_by(before)
                if over:
                    self._end(over)
                try:
                    yield
                finally:
                    changed = self._lease is not before
        finally:
            if changed:
                self._on_change(self.control())

    def _over_by(self, lease: Lease) -> str:
        """What has ended a lease that nobody released or took, '' if nothing has; takes no lock."""
        if self._clock.now_s() >= lease.until_s:
            return f"{NOT_RENEWED} {lease.for_s:g} s"
        if self.was_stopped(lease):
            return self._last_stop.how
        if lease.credential and not self.stands(lease.credential):
            return "the token or the session that it was granted to has ended"
        return ""

    def _check_free(self, caller: Caller) -> str:
        """Pass unless a lease runs, or somebody of another name steers. Raises Leased.

        A lease that gives way is ended; returns why what runs under it is to be stopped, '' if nothing does.
        """
        lease = self._lease
        if lease is not None and lease.preemptible:
            why = f"{caller.name} wants to steer, and {lease.holder} gives way"
            self._end(why)
            return why if self._running() else ""
        control = self.control()
        if control is not None and (control.kind == "lease" or control.holder != caller.name):
            raise Leased(control, self._clock.now_s())
        return ""

    def _held_by(self, lease_id: str) -> Lease:
        """Return the lease that runs, if it is this one."""
        lease = self._lease
        if lease is not None and hmac.compare_digest(lease.id.encode(), lease_id.encode()):
            return lease
        how = self._over.get(lease_id)
        if how is None:
            raise NotNow("lease_unknown", "the lease is not known, or ended long ago; acquire one")
        raise LeaseOver(how)

    def _grant(
        self,
        caller: Caller,
        name: str | None,
        for_s: float,
        preemptible: bool = False,
        last_stop: StopCame | None = None,
        stops_when_silent: bool = False,
    ) -> Lease:
        now_s, holder = self._clock.now_s(), name or caller.name
        times_s = now_s, for_s, now_s + for_s
        lease = Lease(
            secrets.token_hex(16),
            holder,
            *times_s,
            preemptible,
            last_stop,
            caller.credential,
            stops_when_silent,
            caller.name,
        )
        self._lease = lease
        return lease

    def _end(self, how: str) -> None:
        if self._lease is None:
            return
        self._over[self._lease.id] = how
        while len(self._over) > REMEMBERED:
            del self._over[next(iter(self._over))]
        self._lease = None


def _by_the_wall(left_s: float) -> str:
    return (datetime.now(UTC) + timedelta(seconds=left_s)).isoformat()


def _check_time(for_s: float) -> None:
    """Pass how long a lease may be. Raises BadRequest."""
    if not (math.isfinite(for_s) and SHORTEST_S <= for_s <= LONGEST_S):
        raise BadRequest(
            "bad_request", f"for_s: {for_s:g} where {SHORTEST_S:g} to {LONGEST_S:g} seconds are expected"
        )
