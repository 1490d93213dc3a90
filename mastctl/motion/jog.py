"""Jog: the head turns at a rate for as long as heartbeats come.

A rate is carried out as moves to a goal a short way ahead: as far as the head goes until the next ones come
and it has braked. So whatever ends (heartbeats, this process, its machine) leaves that much motion and no
more, and every goal passes the judge with all its limits: an axis at a bound rests while the other goes on.

A heartbeat is good for half a second of the daemon's clock. One that names a jog which has ended moves
nothing, so that none which was delayed on its way begins a motion again; nor does one without a name whose
number shows that others went before it.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import Field

from drivers.clock import Clock
from drivers.interfaces import Reading
from mastctl.answers import JogAnswer
from mastctl.control.machine import busy
from mastctl.control.operations import OperationRunner
from mastctl.devices.devices import Devices
from mastctl.devices.keep_out import KeptOut, Pair
from mastctl.errors import NotNow
from mastctl.motion.requests import Name, PointingError, StrictBody

log = logging.getLogger(__name__)

PATIENCE_S = 0.5  # how long a heartbeat is good for
TICK_S = 0.1  # between goals
AHEAD_S = 0.25  # of motion that a goal lies ahead, beside the braking: two ticks and what a slow line takes
AXES = ("pan", "tilt")
STILL = (0.0, 0.0)

Rate = Annotated[float, Field(ge=-100.0, le=100.0)]


class JogBeat(StrictBody):
    """``POST /jog``: a heartbeat.

    The first one has the ``sequence`` 1 and no ``id``; those that follow have the id that it was answered,
    and rising numbers: one that was delayed on its way is not taken. Rates of zero end the jog.
    """

    pan_rad_per_s: Rate
    tilt_rad_per_s: Rate
    sequence: Annotated[int, Field(ge=1, le=2**53)]
    id: Name | None = None

    @property
    def rates(self) -> Pair:
        """Of pan and tilt, rad/s."""
        return self.pan_rad_per_s, self.tilt_rad_per_s


@dataclass(frozen=True)
class JogEnd:
    """How a jog ended: why, and where the head was when it was stopped."""

    ended_because: str
    pan_rad: float
    tilt_rad: float


class Jogs:
    """The jog of one daemon, at most one at a time; safe to use from any thread.

    A jog is an operation from its first heartbeat to its end: nothing else moves the head meanwhile, and a
    stop ends it. ``undisturbed`` is a context in which a jog begins: what needs a head that rests changes
    before or after.
    """

    def __init__(
        self,
        operations: OperationRunner,
        devices: Devices,
        clock: Clock,
        undisturbed: Callable[[], AbstractContextManager[object]] = nullcontext,
    ) -> None:
        self._operations = operations
        self._devices = devices
        self._clock = clock
        self._undisturbed = undisturbed
        self._lock = threading.Lock()
        self._jog: tuple[str, _Jog] | None = None

    def beat(self, beat: JogBeat) -> JogAnswer:
        """Take a heartbeat; return the jog's ``id``, whether it was ``taken``, and which axis does not turn.

        Raises NotNow ``jog_ended`` if it names a jog that does not run, or none and is not the first;
        ``busy`` if an operation runs, or another jog; else as `OperationRunner.start`.
        """
        if beat.id is None:
            self._operations.let_stopped_end()
        with self._lock:
            if self._jog is not None and self._operations.running != self._jog[0]:
                self._jog = None
            name, running = self._jog or (None, None)
            if beat.id is not None:
                if running is None or name != beat.id:
                    message = f"jog {beat.id[:80]} does not run any more; begin another one without an id"
                    raise NotNow("jog_ended", message)
                return running.take(beat, beat.id)
            if name is not None:
                raise busy(name)
            if beat.rates == STILL:
                return {"id": None, "taken": False, "held": {}}
            if beat.sequence != 1:
                message = f"sequence is {beat.sequence} without an id; 1 begins a jog, its answer has the id"
                raise NotNow("jog_ended", message)
            jog = _Jog(self._devices, self._clock, beat)
            recorded = {"jog": {"pan_rad_per_s": beat.pan_rad_per_s, "tilt_rad_per_s": beat.tilt_rad_per_s}}
            with self._undisturbed():
                begun = self._operations.start(recorded, jog.run).id
            self._jog = begun, jog
            return jog.answer(begun, True)


class _Jog:
    def __init__(self, devices: Devices, clock: Clock, first: JogBeat) -> None:
        self._devices = devices
        self._clock = clock
        self._changed = clock.signal()
        self._beat = first
        self._came_s = clock.now_s()
        self._sent: Pair | None = None
        self._bounded: Mapping[str, str] = {}

    def take(self, beat: JogBeat, name: str) -> JogAnswer:
        with self._changed:
            if beat.sequence <= self._beat.sequence:
                return self.answer(name, False)
            self._beat, self._came_s = beat, self._clock.now_s()
            if beat.rates == STILL:
                self._changed.notify_all()
        return self.answer(name, True)

    def answer(self, name: str, taken: bool) -> JogAnswer:
        return {"id": name, "taken": taken, "held": dict(self._bounded)}

    def run(self, record: Callable[[Any], None], cancelled: threading.Event) -> JogEnd:
        """Turn the head until no heartbeat comes any more; then stop it.

        Raises PointingError ``stopped``, ``head_fault``; MastctlError, DriverError if the head fails; it is
        stopped by the caller then.
        """
        seen_s = self._clock.now_s()
        while True:
            if cancelled.is_set():
                raise PointingError("stopped", "the jog was stopped")
            reading = self._devices.read()
            now_s = self._clock.now_s()
            late_s = max(now_s - self._came_s, now_s - seen_s)
            if self._beat.rates == STILL:
                return self._end("its client let go", reading)
            if late_s > PATIENCE_S:
                why = "the daemon was held up" if now_s - seen_s > PATIENCE_S else "no heartbeat came"
                return self._end(f"{why} for {late_s:.2f} s", reading)
            seen_s = now_s
            if reading.faults:
                raise PointingError("head_fault", f"the head reports: {'; '.join(reading.faults)}")
            self._step(reading)
            with self._changed:
                if self._beat.rates != STILL:
                    self._changed.wait(TICK_S, idle=True)

    def _end(self, why: str, reading: Reading) -> JogEnd:
        self._devices.stop()
        log.info("the jog ends: %s", why)
        return JogEnd(why, reading.pan_rad, reading.tilt_rad)

    def _step(self, reading: Reading) -> None:
        """Send the head a little further, as far as that is free."""
        judge = self._devices.judge
        start = reading.pan_rad, reading.tilt_rad
        rates = _capped(self._beat.rates, judge.limits.speed_rad_per_s)
        stay = self._sent or start
        wanted = tuple(
            at + rate * AHEAD_S + math.copysign(judge.braking_rad(rate), rate) if rate else stays
            for at, rate, stays in zip(start, rates, stay, strict=True)
        )
        goal = judge.nearest(reading, (wanted[0], wanted[1]), stay)
        self._bounded = {
            axis: f"{axis} is held at {to:.4g} rad by a limit or a keep-out"
            for axis, to, want, rate in zip(AXES, goal, wanted, rates, strict=True)
            if rate and abs(want - to) > 1e-6
        }
        if goal == start or goal == self._sent:
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
