"""Jog: the head turns at a rate for as long as heartbeats come.

A rate is carried out as moves to a goal a short way ahead: as far as the head goes until the next ones come
and it has braked. So whatever ends (heartbeats, this process, its machine) leaves that much motion and no
more, and every goal passes the judge with all its limits: an axis at a bound rests while the other goes on.

A heartbeat is good for half a second of the daemon's clock. Heartbeats are numbered: only number 1 begins a
jog, and one that names a jog which has ended moves nothing. So none that was delayed on its way begins a
motion again.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
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
        self._changed = clock.signal()
        self._name: str | None = None
        self._beat = JogBeat(pan_rad_per_s=0.0, tilt_rad_per_s=0.0, sequence=1)
        self._came_s = 0.0
        self._bounded: Mapping[str, str] = {}

    def beat(self, beat: JogBeat) -> JogAnswer:
        """Take a heartbeat; return the jog's ``id``, whether it was ``taken``, and which axis does not turn.

        Raises NotNow ``jog_ended`` if it names a jog that does not run, or none and is not the first;
        ``busy`` if an operation runs, or another jog; else as `OperationRunner.start`.
        """
        if beat.id is None:
            self._operations.let_stopped_end()
        with self._changed:
            runs = self._name is not None and self._operations.running == self._name
            if beat.id is not None:
                if not runs or self._name != beat.id:
                    message = f"jog {beat.id[:80]} does not run any more; begin another one without an id"
                    raise NotNow("jog_ended", message)
                if beat.sequence <= self._beat.sequence:
                    return self._answer(False)
                self._beat, self._came_s = beat, self._clock.now_s()
                if beat.rates == STILL:
                    self._changed.notify_all()
                return self._answer(True)
            if runs and self._name is not None:
                raise busy(self._name)
            if beat.rates == STILL:
                return {"id": None, "taken": False, "held": {}}
            if beat.sequence != 1:
                message = f"sequence is {beat.sequence} without an id; 1 begins a jog, its answer has the id"
                raise NotNow("jog_ended", message)
            self._beat, self._came_s, self._bounded = beat, self._clock.now_s(), {}
            recorded = {"jog": {"pan_rad_per_s": beat.pan_rad_per_s, "tilt_rad_per_s": beat.tilt_rad_per_s}}
            with self._undisturbed():
                self._name = self._operations.start(recorded, self._run).id
            return self._answer(True)

    def _answer(self, taken: bool) -> JogAnswer:
        return {"id": self._name, "taken": taken, "held": dict(self._bounded)}

    def _run(self, record: Callable[[Any], None], cancelled: threading.Event) -> dict[str, Any]:
        """Turn the head until no heartbeat comes any more; stop it, and return why and where.

        Raises PointingError ``stopped``, ``head_fault``; MastctlError, DriverError if the head fails; it is
        stopped by the caller then.
        """
        seen_s, sent = self._clock.now_s(), None
        while True:
            if cancelled.is_set():
                raise PointingError("stopped", "the jog was stopped")
            reading = self._devices.read()
            now_s, rates = self._clock.now_s(), self._beat.rates
            late_s = max(now_s - self._came_s, now_s - seen_s)
            why = "its client let go" if rates == STILL else ""
            if not why and late_s > PATIENCE_S:
                silent = "the daemon was held up" if now_s - seen_s > PATIENCE_S else "no heartbeat came"
                why = f"{silent} for {late_s:.2f} s"
            if why:
                self._devices.stop()
                log.info("the jog ends: %s", why)
                return {"ended_because": why, "pan_rad": reading.pan_rad, "tilt_rad": reading.tilt_rad}
            seen_s = now_s
            if reading.faults:
                raise PointingError("head_fault", f"the head reports: {'; '.join(reading.faults)}")
            sent = self._step(reading, rates, sent)
            with self._changed:
                if self._beat.rates != STILL:
                    self._changed.wait(TICK_S, idle=True)

    def _step(self, reading: Reading, rates: Pair, sent: Pair | None) -> Pair | None:
        """Send the head a little further, as far as that is free; return the goal that it has."""
        judge = self._devices.judge
        start = reading.pan_rad, reading.tilt_rad
        share = min(1.0, judge.limits.speed_rad_per_s / max(map(abs, rates)))  # the same direction
        rates = rates[0] * share, rates[1] * share
        stay = sent or start
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
        if goal in (start, sent):
            return sent
        try:
            self._devices.move(*goal, max(map(abs, rates)))
        except KeptOut:  # it went on since it was read; the goal that it has is free
            return sent
        return goal
