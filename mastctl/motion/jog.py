"""Jog: the head turns at a rate for as long as somebody keeps saying so.

A rate is carried out as moves to a goal a short way ahead: as far as the head goes until the next ones come
and it has braked. So whatever ends (heartbeats, this process, its machine) leaves that much motion and no
more, and every goal passes the door with all its limits: an axis at a bound stands while the other goes on.

A heartbeat is good for half a second of the daemon's clock. One that names a jog which has ended moves
nothing, so that none which was held up on its way begins a motion again. Nor does one that names no jog and
follows others through a stop, whether these moved the head or were refused: its client lets go first.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any, Protocol

from drivers.clock import Clock, SystemClock
from drivers.interfaces import Reading
from mastctl.answers import JogTold
from mastctl.control.operations import OperationRunner
from mastctl.control.refusals import busy
from mastctl.devices.judge import KeepOutJudge
from mastctl.devices.keep_out import KeptOut, Pair
from mastctl.errors import MastctlError, NotNow
from mastctl.motion.results import PointingError

log = logging.getLogger(__name__)

PATIENCE_S = 0.5  # how long a heartbeat is good for
GONE_S = 30.0  # of the machine's own time: a client that is not heard of where a simulation's time stands
TICK_S = 0.1  # between goals
AHEAD_S = 0.25  # of motion that a goal lies ahead, beside the braking: two ticks and what a slow line takes
AXES = ("pan", "tilt")


class JogDevices(Protocol):
    """What of `mastctl.devices.devices.Devices` a jog needs."""

    @property
    def door(self) -> KeepOutJudge: ...
    def read(self) -> Reading: ...
    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None: ...
    def stop(self) -> None: ...


@dataclass(frozen=True)
class Beat:
    """A heartbeat.

    Attributes
    ----------
    rates_rad_per_s
        Of pan and tilt; zero of both ends the jog.
    sequence
        Its number; one that is not above the last one's came late and is not taken. None: none are counted.
    jog
        Which jog it belongs to; None begins one, or goes on with one that counts none.
    """

    rates_rad_per_s: Pair
    sequence: int | None = None
    jog: str | None = None


@dataclass(frozen=True)
class JogEnd:
    """How a jog ended: why, and where the head was when it was told to stop."""

    ended_because: str
    pan_rad: float
    tilt_rad: float


class Jogs:
    """The jog of one daemon, at most one at a time; safe to use from any thread.

    Parameters
    ----------
    operations
        A jog is an operation from its first heartbeat to its end: nothing else moves the head meanwhile, and
        a stop ends it.
    devices
        The head.
    clock
        What heartbeats are good by.
    people
        What clients live by, whatever the clock of a simulated rover does; the machine's own by default.
    undisturbed
        A context in which a jog begins, for what needs a head that rests: it changes before or after.
    last_stop
        Returns the last stop that anybody asked for, another object as soon as another one comes.
    """

    def __init__(
        self,
        operations: OperationRunner,
        devices: JogDevices,
        clock: Clock,
        people: Clock | None = None,
        undisturbed: Callable[[], AbstractContextManager[object]] = nullcontext,
        last_stop: Callable[[], object] = lambda: None,
    ) -> None:
        self._undisturbed = undisturbed
        self._last_stop = last_stop
        # Of heartbeats that name no jog, with numbers and without: the newest, and the last stop before them.
        self._nameless: dict[bool, tuple[float, object]] = {}
        self._operations = operations
        self._devices = devices
        self._clock = clock
        self._people = people or SystemClock()
        self._lock = threading.Lock()
        self._jog: tuple[str, _Jog] | None = None

    @contextmanager
    def heard(self, beat: Beat) -> Iterator[bool]:
        """Hear a heartbeat before anybody may refuse it; the block carries it out. Used on one thread.

        Yields whether it may begin a jog. One that names none may not if it follows others within
        `PATIENCE_S`, and a stop came since the first of these. Of those with numbers only what was refused
        counts: a client that numbers them names its jog as soon as it has one.
        """
        if beat.jog is not None or beat.rates_rad_per_s == (0.0, 0.0):
            yield True
            return
        counts, now_s, stop = beat.sequence is not None, self._clock.now_s(), self._last_stop()
        newest_s, since = self._nameless.get(counts, (-math.inf, stop))
        if now_s - newest_s > PATIENCE_S:
            since = stop
        if not counts:
            self._nameless[counts] = now_s, since
        try:
            yield since is stop
        except MastctlError:
            if counts:
                self._nameless[counts] = now_s, since
            raise

    def beat(self, beat: Beat, may_begin: bool = True) -> JogTold:
        """Take a heartbeat; return the jog's ``id``, whether it was ``taken``, and what holds an axis.

        ``may_begin`` is what `heard` yielded.

        Raises
        ------
        NotNow
            ``jog_ended`` if it names a jog that does not run, or may not begin one; ``busy`` if an operation
            runs, or a jog that counts its heartbeats and is not named; else as `OperationRunner.start`.
        """
        if beat.jog is None:
            self._operations.let_stopped_end()
            if not may_begin:
                raise self._operations.refusal("motion") or NotNow(
                    "jog_ended",
                    "a stop ended the jog of these heartbeats; send none that turns the head for "
                    f"{PATIENCE_S:g} s, then begin another",
                )
        with self._lock:
            running = self._running()
            if beat.jog is not None:
                if running is None or running[0] != beat.jog:
                    raise NotNow(
                        "jog_ended",
                        f"jog {beat.jog[:80]} does not run any more; begin another one without an id",
                    )
                return running[1].take(beat, running[0])
            if running is not None:
                if running[1].counts:
                    raise busy(running[0])
                return running[1].take(beat, running[0])
            if beat.rates_rad_per_s == (0.0, 0.0):
                return {"id": None, "taken": False, "held": {}}
            jog = _Jog(self._devices, self._clock, self._people, beat)
            pan, tilt = beat.rates_rad_per_s
            asked = {"jog": {"pan_rad_per_s": pan, "tilt_rad_per_s": tilt}}
            with self._undisturbed():
                name = self._operations.start(asked, jog.run).id
            self._jog = name, jog
            threading.Thread(target=jog.watch, name="jog's client", daemon=True).start()
            return jog.told(name, True)

    def _running(self) -> tuple[str, _Jog] | None:
        if self._jog is not None and self._operations.running != self._jog[0]:
            self._jog = None
        return self._jog


class _Jog:
    """One jog."""

    def __init__(self, devices: JogDevices, clock: Clock, people: Clock, first: Beat) -> None:
        self._devices = devices
        self._clock = clock
        self._people = people
        self._heard_s = people.now_s()
        self._gone = False
        self._over = people.signal()
        self._is_over = False
        self._changed = clock.signal()
        self._beat = first
        self._came_s = clock.now_s()
        self._sent: Pair | None = None
        self._held: Mapping[str, str] = {}

    @property
    def counts(self) -> bool:
        """Whether its heartbeats are numbered."""
        return self._beat.sequence is not None

    def watch(self) -> None:
        """End the jog when nothing is heard of its client for `GONE_S`; where time stands, only this does."""
        with self._over:
            while not self._is_over:
                left_s = self._heard_s + GONE_S - self._people.now_s()
                if left_s <= 0.0:
                    break
                self._over.wait(left_s)
            else:
                return
        with self._clock.at_work(), self._changed:
            self._gone = True
            self._changed.notify_all()

    def take(self, beat: Beat, name: str) -> JogTold:
        """Take a heartbeat, unless a later one came before it."""
        self._heard_s = self._people.now_s()
        with self._changed:
            last = self._beat.sequence
            if last is not None and (beat.sequence is None or beat.sequence <= last):
                return self.told(name, False)
            self._beat, self._came_s = beat, self._clock.now_s()
            if beat.rates_rad_per_s == (0.0, 0.0):
                self._changed.notify_all()
        return self.told(name, True)

    def told(self, name: str, taken: bool) -> JogTold:
        """What a heartbeat is answered."""
        return {"id": name, "taken": taken, "held": dict(self._held)}

    def run(self, record: Callable[[Any], None], cancelled: threading.Event) -> JogEnd:
        """Turn the head until nobody says so any more; then stop it.

        Raises
        ------
        PointingError
            ``stopped``, ``head_fault``.
        MastctlError, DriverError
            If the head fails; whoever runs this stops it then.
        """
        try:
            return self._run(cancelled)
        finally:
            with self._over:
                self._is_over = True
                self._over.notify_all()

    def _run(self, cancelled: threading.Event) -> JogEnd:
        seen_s = self._clock.now_s()
        while True:
            if cancelled.is_set():
                raise PointingError("stopped", "the jog was stopped")
            reading = self._devices.read()
            now_s = self._clock.now_s()
            late_s = max(now_s - self._came_s, now_s - seen_s)
            if self._beat.rates_rad_per_s == (0.0, 0.0):
                return self._end("its client let go", reading)
            if self._gone:
                return self._end(f"nothing was heard of its client for {GONE_S:g} s", reading)
            if late_s > PATIENCE_S:
                held_up = now_s - seen_s > PATIENCE_S
                why = "the daemon was held up" if held_up else "no heartbeat came"
                return self._end(f"{why} for {late_s:.2f} s", reading)
            seen_s = now_s
            if reading.faults:
                raise PointingError("head_fault", f"the head reports: {'; '.join(reading.faults)}")
            self._step(reading)
            with self._changed:
                if self._beat.rates_rad_per_s != (0.0, 0.0) and not self._gone:
                    self._changed.wait(TICK_S, idle=True)

    def _end(self, why: str, reading: Reading) -> JogEnd:
        self._devices.stop()
        log.info("the jog ends: %s", why)
        return JogEnd(why, reading.pan_rad, reading.tilt_rad)

    def _step(self, reading: Reading) -> None:
        """Send the head a little further, as far as that is free."""
        door = self._devices.door
        here = reading.pan_rad, reading.tilt_rad
        rates = _capped(self._beat.rates_rad_per_s, door.limits.speed_rad_per_s)
        stay = self._sent or here
        wanted = tuple(
            at + rate * AHEAD_S + math.copysign(door.braking_rad(rate), rate) if rate else stays
            for at, rate, stays in zip(here, rates, stay, strict=True)
        )
        goal = door.nearest(reading, (wanted[0], wanted[1]), stay)
        self._held = {
            axis: f"{axis} is held at {to:.4g} rad by a limit or a keep-out"
            for axis, to, want, rate in zip(AXES, goal, wanted, rates, strict=True)
            if rate and abs(want - to) > 1e-6
        }
        if goal == here or goal == self._sent:
            return
        try:
            self._devices.move(*goal, max(abs(rate) for rate in rates))
        except KeptOut:
            return  # it went on since it was read; the goal that it has is free
        self._sent = goal


def _capped(rates: Pair, most: float) -> Pair:
    """Rates as fast as allowed, in the same direction."""
    fastest = max(abs(rate) for rate in rates)
    share = min(1.0, most / fastest) if fastest else 1.0
    return rates[0] * share, rates[1] * share
