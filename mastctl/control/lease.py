"""The client that steers: the holder of the one lease, or without one the client that started what runs.

A lease runs on the machine's clock, however fast a simulated rover's goes: it bounds how long a client may
be silent, and clients live in real time. It runs until just before its end. Its id proves it, so only its
holder's answers have it. Whatever ends a lease stops the motion that was begun under it.

Reading (`LeaseTable.control`) takes no lock.
"""

from __future__ import annotations

import contextlib
import logging
import secrets
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta

from drivers.clock import Clock
from mastctl.answers import ControlAnswer, LeaseRuns, Role
from mastctl.errors import NotAllowed, NotNow, one_line

log = logging.getLogger(__name__)

ROLES: tuple[Role, ...] = ("view", "operate", "admin")

ANONYMOUS = "anonymous"
LONGEST_NAME = 80
NETWORK = "network"
SHORTEST_S, USUAL_S, LONGEST_S = 1.0, 30.0, 3600.0
WATCH_S = 0.2  # how late what runs is stopped after its lease has run out
AGAIN_S = 1.0  # between such stops while the head does not confirm one
REMEMBERED = 64  # ended leases for which a refusal still states how they ended


@dataclass(frozen=True)
class Caller:
    """The client of a request. Equal callers are one party.

    Its ``name`` is given by the client and proves nothing. On the path that needs no token every client is
    ``admin``. ``via``: ``loopback``, ``unix``, ``token``, ``inside`` (this process itself), ``network`` (a
    stranger without a valid token). ``credential``: digest of its token; empty without one.
    """

    name: str = ANONYMOUS
    role: Role = "admin"
    via: str = "loopback"
    address: str = field(default="", compare=False)
    credential: str = field(default="", compare=False, repr=False)

    @property
    def stranger(self) -> bool:
        """Whether only its address is known."""
        return self.via == NETWORK

    def may(self, role: Role) -> bool:
        """Return whether it has the rights of ``role``."""
        return ROLES.index(self.role) >= ROLES.index(role)

    def check_may(self, role: Role, command: str) -> None:
        """Pass a client with the rights of ``role``. Raises NotAllowed ``role``."""
        if not self.may(role):
            raise NotAllowed("role", f"{self.name} may {self.role}; {command} needs the role {role}")


def client_name(header: str | None) -> str:
    """Return the name that a client gives itself as one printable line of 80 characters at most.

    `ANONYMOUS` for an empty one. Headers are read as Latin-1, and as UTF-8 where that is possible. Never
    refuses: a stop with a strange name is a stop.
    """
    name = header or ""
    with contextlib.suppress(UnicodeError):
        name = name.encode("latin-1").decode()
    return one_line(name, LONGEST_NAME).strip() or ANONYMOUS


class Leased(NotNow):
    """Another client steers; ``detail`` has its name, and for how long."""

    def __init__(self, control: ControlAnswer) -> None:
        self.detail, for_s = control, control["for_s"]
        until = "until what runs has ended" if for_s is None else f"for {for_s:.1f} s more"
        super().__init__("leased", f"{control['holder']} steers, {until}; wait, or take over with a reason")


class LeaseOver(NotNow):
    """A lease has ended; ``detail`` has ``how``."""

    def __init__(self, how: str) -> None:
        self.detail = {"how": how}
        super().__init__("lease_over", f"the lease has ended: {how}; acquire another")


@dataclass(frozen=True, eq=False)
class StopCame:
    """A stop that came: which, and by which client."""

    how: str = "the head was stopped"


@dataclass(frozen=True)
class Lease:
    """The right to steer until ``until_s``, seconds of the lease's clock; it ends with its caller's token.

    ``last_stop`` is that of `LeaseTable.last_stop` after which the next one ends it; None: no stop does.
    """

    id: str
    holder: str
    caller: Caller
    for_s: float
    until_s: float
    last_stop: StopCame | None = None


class LeaseTable:
    """The lease of one daemon, or the client that steers without one; safe to use from any thread.

    ``running``: whether an operation or a track runs; called with the lock kept, so it must take none.
    ``on_change`` follows each change; ``stop`` stops what runs, and gets the reason: both without the lock.
    ``token_is_valid``: of a token's digest; called with the lock kept, from any thread.
    """

    def __init__(
        self,
        clock: Clock,
        running: Callable[[], bool],
        on_change: Callable[[], None] = lambda: None,
        stop: Callable[[str], object] = lambda why: None,
    ) -> None:
        self._clock = clock
        self._running = running
        self._on_change = on_change
        self._stop = stop
        self.token_is_valid: Callable[[str], bool] = lambda credential: True
        self._last_stop = StopCame()
        self._lock = threading.Lock()
        self._lease: Lease | None = None
        self._over: dict[str, str] = {}  # id of an ended lease: how it ended
        self._under_way: dict[object, str] = {}  # commands that are being carried out: their party
        self._party: str | None = None  # the client that started what runs
        self._left = ""  # why what runs is to be stopped: its lease has ended
        self._closing = threading.Event()

    def control(self) -> ControlAnswer | None:
        """Return the client that steers now; takes no lock."""
        lease = self._lease
        if lease is not None and not self._over_by(lease):
            return {"kind": "lease", **self.lease_as_json(lease)}
        under_way = next(iter(tuple(self._under_way.values())), None)
        party = under_way or (self._party if self._running() else None)
        return None if party is None else {"holder": party, "kind": "operation", "for_s": None, "until": None}

    def lease_as_json(self, lease: Lease) -> LeaseRuns:
        """Return what is left of a lease, seconds, and its end by the wall clock (UTC)."""
        left_s = max(0.0, lease.until_s - self._clock.now_s())
        until = datetime.now(UTC) + timedelta(seconds=left_s)
        return {"holder": lease.holder, "for_s": left_s, "until": until.isoformat()}

    @property
    def last_stop(self) -> StopCame:
        """The last stop; another object as soon as another one comes. Takes no lock."""
        return self._last_stop

    def stop_came(self, how: str = "the head was stopped") -> None:
        """End a lease that ends with a stop: the head is being stopped. Takes no lock, waits for nothing."""
        self._last_stop = StopCame(how)

    def was_stopped(self, lease: Lease) -> bool:
        """Return whether a stop has come that ends a lease; takes no lock."""
        return lease.last_stop is not None and lease.last_stop is not self._last_stop

    def acquire(
        self,
        caller: Caller,
        name: str | None = None,
        for_s: float = USUAL_S,
        last_stop: StopCame | None = None,
    ) -> Lease:
        """Return a new lease of ``for_s`` seconds if no other client steers; what the caller runs is its own.

        ``name`` is the holder's, the caller's by default. With ``last_stop`` it ends with the first stop of
        the head after that one. Raises Leased.
        """
        with self._changing():
            self._check_free(caller)
            return self._grant(caller, name, for_s, last_stop)

    def watch(self) -> None:
        """Stop what runs whenever its lease has run out or lost its token, until `close`."""
        pause_s = WATCH_S
        while not self._closing.wait(pause_s):
            pause_s = WATCH_S
            try:
                self.stop_left_running()
            except Exception as error:
                log.error("%s: %s; the stop is sent again", self._left, error)
                pause_s = AGAIN_S

    def stop_left_running(self) -> None:
        """Stop what runs without its lease, if anything; at each call until the head confirms it."""
        with self._changing():
            why = self._left
        if why:
            self._stop(why)
            with self._lock:
                self._left = "" if self._left == why else self._left

    def close(self) -> None:
        """Stop nothing any more: the service has stopped the head, and ends."""
        self._closing.set()

    def holds(self, lease_id: str) -> bool:
        """Return whether a lease runs now; takes no lock."""
        lease = self._lease
        return lease is not None and lease.id == lease_id and not self._over_by(lease)

    def renew(self, lease_id: str, for_s: float | None = None) -> Lease:
        """Have a lease run for ``for_s`` seconds from now on, by default as long as at first; return it.

        Raises LeaseOver; NotNow ``lease_unknown``.
        """
        with self._changing():
            lease = self._running_lease(lease_id)
            for_s = for_s or lease.for_s
            self._lease = replace(lease, for_s=for_s, until_s=self._clock.now_s() + for_s)
            return self._lease

    def release(self, lease_id: str) -> None:
        """End a lease and stop what runs under it. Raises NotNow as `renew`; DriverError."""
        with self._changing():
            self._running_lease(lease_id)
            self._end("it was released")
        self.stop_left_running()

    def take(
        self,
        caller: Caller,
        reason: str,
        name: str | None = None,
        for_s: float = USUAL_S,
        last_stop: StopCame | None = None,
    ) -> Lease:
        """Return a new lease, whichever client steers; the former holder gets the new one's name and reason.

        What runs under a lease is stopped; there is no lease if the head does not confirm that. Else as
        `acquire`; raises DriverError.
        """
        how = f"{name or caller.name} took over: {reason}"
        with self._changing():
            self._end(how)
        self.stop_left_running()
        with self._changing():
            self._end(how)  # another client's since then
            return self._grant(caller, name, for_s, last_stop)

    @contextmanager
    def steering(self, caller: Caller, lease_id: str | None) -> Iterator[None]:
        """Let a command that steers be carried out inside the block; waits for nothing.

        Until it has ended, and what it started too, no other client gets a lease or steers, unless by `take`.
        Raises Leased, and as `renew` for the lease that came with it.
        """
        ticket = object()
        lease: Lease | None = None
        with self._changing():
            if lease_id is not None:
                lease = self._running_lease(lease_id)
            else:
                self._check_free(caller)
            party = caller.name if lease is None else lease.holder
            self._under_way[ticket] = party
            anothers = self._running()
        try:
            yield
            anothers = False  # it was carried out: what runs from now on is its
        finally:
            with self._changing():
                del self._under_way[ticket]
                if not anothers:
                    self._party, self._left = party, ""
                    if lease is not None and (how := self._over.get(lease.id)):  # meanwhile
                        self._leave_running(lease, how)

    # The lock is kept

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """Keep the lock, with a lease that has run out ended; report a change after it."""
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
                self._on_change()

    def _over_by(self, lease: Lease) -> str:
        """What has ended a lease that was not released or taken, '' if nothing has; takes no lock."""
        if self._clock.now_s() >= lease.until_s:
            return f"the lease was not renewed for {lease.for_s:g} s"
        if self.was_stopped(lease):
            return self._last_stop.how
        credential = lease.caller.credential
        if credential and not self.token_is_valid(credential):
            return "the token that it was granted to has ended"
        return ""

    def _check_free(self, caller: Caller) -> None:
        """Pass unless a lease runs, or a client of another name steers. Raises Leased."""
        control = self.control()
        if control is not None and (control["kind"] == "lease" or control["holder"] != caller.name):
            raise Leased(control)

    def _running_lease(self, lease_id: str) -> Lease:
        """Return the lease that runs, if it is this one."""
        lease = self._lease
        if lease is not None and lease.id == lease_id:
            return lease
        how = self._over.get(lease_id)
        if how is None:
            raise NotNow("lease_unknown", "the lease is not known, or ended long ago; acquire one")
        raise LeaseOver(how)

    def _grant(self, caller: Caller, name: str | None, for_s: float, last_stop: StopCame | None) -> Lease:
        until_s = self._clock.now_s() + for_s
        self._lease = Lease(secrets.token_hex(16), name or caller.name, caller, for_s, until_s, last_stop)
        return self._lease

    def _end(self, how: str) -> None:
        lease = self._lease
        if lease is None:
            return
        self._over[lease.id] = how
        while len(self._over) > REMEMBERED:
            del self._over[next(iter(self._over))]
        self._lease = None
        if self._party in (lease.holder, lease.caller.name) and not self.was_stopped(lease):
            self._leave_running(lease, how)

    def _leave_running(self, lease: Lease, how: str) -> None:
        """Note what runs under a lease that has ended, for `stop_left_running`."""
        if self._running():
            self._left = f"{lease.holder} began it, and its lease has ended: {how}"
