"""Simulated heads among random keep-outs, by their true angles.

Each case is a head of its own (axes of unequal speed and acceleration, backlash, sag, ringing, an approach
from one side or none) among random boxes, with the margin that such a head needs. It is pointed among them,
sent elsewhere while it moves, jogged, and stopped at any moment; a command takes up to 0.08 s from its
reading to the axes. Every 10 ms the true, mechanical angles are compared with the boxes.
"""

from __future__ import annotations

import math
import random
from collections import Counter
from dataclasses import dataclass, replace

from drivers.clock import ManualClock
from drivers.interfaces import Reading
from drivers.sim.axis import AxisSettings
from drivers.sim.heads import PRESETS, HeadModel
from drivers.sim.pan_tilt import SimulatedPanTilt
from mastctl.devices.judge import KeepOutJudge, Limits
from mastctl.devices.keep_out import Box, KeptOut, Pair, Span
from mastctl.devices.thread import REST_S
from mastctl.motion.jog import AHEAD_S, TICK_S

LOOK_S = 0.01
LATEST_S = 0.08
ACTIONS = 12
PAN, TILT = (-2.4, 2.4), (-1.1, 0.5)


@dataclass
class Driven:
    """What one case came to: counts, the deepest place in a box and the least margin that was left."""

    counts: Counter[str]
    deepest_rad: float = 0.0
    least_rad: float = math.inf


def case(seed: str, checked: bool = True, actions: int = ACTIONS) -> Driven:
    """Drive one head among its boxes."""
    return _Drive(random.Random(seed), checked).run(actions)


class _Drive:
    """One head, its boxes, and a clock that is turned a little at a time."""

    def __init__(self, rng: random.Random, checked: bool) -> None:
        self._rng = rng
        self._checked = checked
        head = _head(rng)
        self._clock = ManualClock(100.0)
        self._head = SimulatedPanTilt(head, self._clock)
        boxes = _boxes(rng)
        speed = rng.uniform(0.2, 1.6)
        self._limits = Limits(PAN, TILT, speed, _margin_rad(head), keep_out=boxes)
        self._door = KeepOutJudge(self._limits, self._head, self._clock, "pan_tilt", None, None)
        self._boxes = [copy for box in boxes for copy in box.within(PAN)]
        self._found = Driven(Counter())

    def run(self, actions: int) -> Driven:
        """Begin somewhere free, then do so many things."""
        start = self._free_place()
        if start is None:
            return self._found
        self._head.move(*start)
        self._clock.advance(30.0)
        for _ in range(actions):
            self._rng.choice((self._point, self._point, self._elsewhere, self._jog, self._stop))()
        self._wait(3.0)
        return self._found

    def _point(self) -> None:
        """Go to a place from rest, or to the nearest free goal; now and then broken off."""
        goal = self._free_place()
        if goal is None:
            return
        self._until_rest()
        reading = self._head.read()
        try:
            self._door.check_from((reading.pan_rad, reading.tilt_rad), goal)
        except KeptOut as refused:
            self._found.counts["keep_out"] += 1
            if refused.nearest is None:
                return
            goal = refused.nearest
        self._found.counts["pointed" if self._send(goal) else "goal refused"] += 1
        if self._rng.random() < 0.15:
            self._wait(self._rng.uniform(0.0, 1.5))
            self._found.counts["broken off"] += 1
            return
        self._until_rest()

    def _elsewhere(self) -> None:
        """Send goals one after another, from rest or not, whatever lies between."""
        for _ in range(self._rng.randint(1, 5)):
            goal = self._rng.uniform(*PAN), self._rng.uniform(*TILT)
            if self._rng.random() < 0.5:
                reading = self._head.read()
                near = self._rng.uniform(0.02, 0.6)
                goal = (
                    _into(reading.pan_rad + self._rng.uniform(-near, near), PAN),
                    _into(reading.tilt_rad + self._rng.uniform(-near, near), TILT),
                )
            taken = self._send(goal)
            self._found.counts["sent" if taken else "refused"] += 1
            self._wait(self._rng.uniform(0.0, 0.8))

    def _jog(self) -> None:
        """Rates that change, carried out as `mastctl.motion.jog` does."""
        sent: Pair | None = None
        for _ in range(self._rng.randint(1, 4)):
            fastest = self._limits.speed_rad_per_s
            rates = self._rng.uniform(-fastest, fastest), self._rng.uniform(-fastest, fastest)
            for _ in range(self._rng.randint(1, 15)):
                reading = self._head.read()
                here = reading.pan_rad, reading.tilt_rad
                ahead = [
                    at + rate * AHEAD_S + math.copysign(self._door.braking_rad(rate), rate)
                    for at, rate in zip(here, rates, strict=True)
                ]
                goal = self._door.nearest(reading, (ahead[0], ahead[1]), sent or here)
                if goal != here and self._send(goal, max(map(abs, rates))):
                    sent = goal
                    self._found.counts["jog"] += 1
                self._wait(TICK_S)
        self._stop()

    def _stop(self) -> None:
        self._head.stop()
        self._found.counts["stop"] += 1
        self._wait(self._rng.uniform(0.0, 0.6))

    def _send(self, goal: Pair, speed_rad_per_s: float | None = None) -> bool:
        """What `mastctl.devices.devices.Devices.move` does: measure, judge, send; the command travels."""
        speed = self._limits.speed(speed_rad_per_s)

        def read() -> Reading:
            return self._head.read()

        try:
            start: Span | None = self._door.check_move(goal, read)
        except KeptOut:
            if self._checked:
                return False
            start = None
        self._wait(self._rng.uniform(0.0, LATEST_S))
        self._door.sent(start, goal, speed)
        self._head.move(*goal, speed)
        return True

    def _until_rest(self) -> None:
        for _ in range(20000):
            self._wait(0.02)
            if not self._head.read().moving:
                break
        self._wait(REST_S + 0.05)

    def _wait(self, duration_s: float) -> None:
        """Let time pass, and look where the head truly is."""
        until_s = self._clock.now_s() + duration_s
        while self._clock.now_s() < until_s:
            self._clock.advance(min(LOOK_S, until_s - self._clock.now_s() + 1e-9))
            place = self._head.true_joints(self._clock.now_s())
            for box in self._boxes:
                inside = _inside_rad(place, box)
                self._found.deepest_rad = max(self._found.deepest_rad, inside)
                self._found.least_rad = min(self._found.least_rad, -inside)

    def _free_place(self) -> Pair | None:
        for _ in range(200):
            place = self._rng.uniform(*PAN), self._rng.uniform(*TILT)
            try:
                self._door.check_goal(*place)
            except KeptOut:
                continue
            return place
        return None


def _head(rng: random.Random) -> HeadModel:
    """Two axes that have little in common."""
    preset = PRESETS[rng.choice(sorted(PRESETS))]
    approach = rng.choice((0.0, 0.0, 0.01, 0.05))
    ring_hz = rng.choice((0.0, 3.0, 8.0))

    def axis(settings: AxisSettings) -> AxisSettings:
        backlash = rng.choice((0.0, 0.001, 0.0044))
        return replace(
            settings,
            backlash_rad=backlash,
            approach_rad=approach if approach > 2 * backlash else 0.0,
            speed_rad_per_s=rng.uniform(0.2, 1.6),
            acceleration_rad_per_s2=10 ** rng.uniform(-0.4, 0.8),
            ring_hz=ring_hz,
            ring_damping=rng.uniform(0.02, 0.2),
        )

    return HeadModel(preset.name, axis(preset.pan), axis(preset.tilt))


def _margin_rad(head: HeadModel) -> float:
    """What such a head needs around a box: backlash, counts, sag, and ringing that meets itself."""
    axes = (head.pan, head.tilt)
    ringing = [
        6.0 * axis.acceleration_rad_per_s2 / (math.tau * axis.ring_hz) ** 2 if axis.ring_hz else 0.0
        for axis in axes
    ]
    parts = [
        axis.backlash_rad + 2 * axis.count_rad + axis.sag_rad + rings
        for axis, rings in zip(axes, ringing, strict=True)
    ]
    return min(0.3, max(parts) + 1e-4)


def _boxes(rng: random.Random) -> tuple[Box, ...]:
    boxes = []
    for number in range(rng.randint(1, 5)):
        pan, tilt = rng.uniform(*PAN), rng.uniform(*TILT)
        wide, high = rng.choice((0.05, 0.3, 1.0)), rng.choice((0.05, 0.3, 0.9))
        boxes.append(
            Box(
                f"box{number}",
                (pan, pan + wide * rng.uniform(0.2, 1)),
                (tilt, tilt + high * rng.uniform(0.2, 1)),
            )
        )
    return tuple(boxes)


def _inside_rad(place: Pair, box: Box) -> float:
    """How far inside a box a place is, radians; negative outside."""
    return min(
        place[0] - box.pan_rad[0],
        box.pan_rad[1] - place[0],
        place[1] - box.tilt_rad[0],
        box.tilt_rad[1] - place[1],
    )


def _into(value: float, limits: Pair) -> float:
    return min(max(value, limits[0]), limits[1])
