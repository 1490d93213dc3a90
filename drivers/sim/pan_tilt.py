"""The simulated heads: one in memory, and one behind bytes: its simulator, a line in memory, the real driver.

The simulated rover uses the second where a configuration says ``simulation.wire``. The cameras look from the
axes of the simulator, so what they show followed from the bytes.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

from drivers.clock import Clock
from drivers.errors import BadOptions, BadReply, DriverError, NoReply
from drivers.faults import PAN_TILT, Fault, FaultPanel
from drivers.interfaces import AxisMotion, HeadInfo, PanTilt, Reading
from drivers.serial_line import OpenLine
from drivers.sim.axis import AxisSettings, WireAxis
from drivers.sim.heads import WIRED_HEADS, HeadModel, WireModel, check_head
from drivers.sim.wire.carrier import WireDevice
from drivers.sim.wire.dynamixel_bus import DynamixelBus
from drivers.sim.wire.dynamixel_models import BAUD_RATES
from drivers.sim.wire.dynamixel_servo import SimulatedServo
from drivers.sim.wire.line import MemoryLine
from drivers.sim.wire.ptu import SimulatedPtu

_T = TypeVar("_T")

REPLY_TIMEOUT_S = 0.1
"""How long a caller waits for a head that does not answer, seconds."""

LOWEST_SUPPLY = 0.8
"""Fraction of the nominal voltage under which the head complains: 9.5 V of 12 V, a Dynamixel X's default."""

HOTTEST_C = 80.0
"""Temperature over which the head complains, degrees Celsius: a Dynamixel X's default."""

_MARGIN_RAD = math.radians(0.5)
"""How far inside the simulator's own range the driver's limits are."""

_WATCHDOG_S, _BRAKING_S = 0.38, 0.095
"""On the machine's clock renderer, simulator and driver share one process, which on a busy machine is silent
for 0.3 s now and then. So the servos wait longer than usual, and brake harder, since they must stand 0.5 s
after the last packet."""


class SimulatedPanTilt(PanTilt):
    """A head in memory; safe from any thread.

    A new goal while under way replaces the old one without a jump in position or velocity.
    """

    def __init__(self, head: HeadModel, clock: Clock, faults: FaultPanel | None = None) -> None:
        self.head = head
        self._clock = clock
        self._faults = faults or FaultPanel(clock.now_s, ())
        self._lock = threading.RLock()
        now_s = clock.now_s()
        self._axes = _axes(head, self._faults, now_s, resumes=False)
        self._closed = False

    def read(self) -> Reading:
        """Return the motor-side angles in whole counts.

        Raises NoReply under faults that keep the answer away, and after ``close``; BadReply under faults that
        damage it.
        """
        return self._call(self._reading)

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        """Start towards the angles, rounded to counts, and return at once.

        ``speed_rad_per_s`` bounds each axis; left out, or above the axis's own, the axis's own holds. Raises
        DriverError for a goal outside the device's own range, or an angle or speed that is not a usable
        number; nothing moves then; NoReply, BadReply.
        """
        axes = (("pan", self.head.pan, pan_rad), ("tilt", self.head.tilt, tilt_rad))
        for name, axis, goal in axes:
            if not axis.low_rad <= goal <= axis.high_rad:
                raise DriverError(
                    f"{name} {goal:.4f} rad is outside the device's own range "
                    f"{axis.low_rad:.4f} to {axis.high_rad:.4f} rad",
                    device=self.head.name,
                )
        speed = math.inf if speed_rad_per_s is None else speed_rad_per_s
        if not speed > 0:
            raise DriverError(
                f"speed {speed_rad_per_s} rad/s is not a positive number", device=self.head.name
            )

        def start(now_s: float) -> None:
            for axis, goal_rad in zip(self._axes, (pan_rad, tilt_rad), strict=True):
                axis.to_count(now_s, goal_rad, speed)

        self._call(start)

    def stop(self) -> None:
        """Brake both axes; they stay where they come to rest. Raises NoReply and BadReply as ``read``."""
        self._call(self._halt)

    def close(self) -> None:
        """Stop and let go; further calls fail with NoReply."""
        with self._lock:
            if not self._closed:
                self._halt(self._clock.now_s())
            self._closed = True

    @property
    def info(self) -> HeadInfo:
        """How each axis moves, by its settings; with an approach it rises to every goal."""
        axes = {"pan": self.head.pan, "tilt": self.head.tilt}
        motion = {
            name: AxisMotion(
                axis.acceleration_rad_per_s2,
                axis.approach_rad,
                math.inf if axis.approach_rad > 0 else None,
                axis.count_rad,
            )
            for name, axis in axes.items()
        }
        return HeadInfo(simulated=True, motion=motion)

    def true_joints(self, time_s: float) -> tuple[float, float]:
        """Return the mechanical pan and tilt at a moment of the last minute, radians. Never fails."""
        with self._lock:
            now_s = self._clock.now_s()
            for axis in self._axes:
                axis.follow(now_s)
            pan, tilt = (axis.mechanical_rad(time_s) for axis in self._axes)
        return pan, tilt

    def _halt(self, now_s: float) -> None:
        for axis in self._axes:
            axis.halt(now_s)

    def _reading(self, now_s: float) -> Reading:
        """The reading of a moment, as a fault leaves it."""
        counts = []
        for axis in self._axes:
            count = axis.settings.count_rad
            counts.append(round(axis.angle_rad(now_s) / count) * count)
        moving = any(axis.under_way(now_s) or axis.settles(now_s) for axis in self._axes)
        stuck = self._faults.find(PAN_TILT, "stuck", now_s)
        if stuck is not None and not self._faults.find(PAN_TILT, "off", now_s):
            seized = all(axis.seized(now_s) for axis in self._axes)
            moving = stuck.number("moving") > 0 or (moving and not seized)
        if fault := self._faults.find(PAN_TILT, "garbage", now_s):
            counts = [self._absurd(fault) for _ in counts]
        counts = [
            math.nan if axis.no_number(now_s) else count
            for axis, count in zip(self._axes, counts, strict=True)
        ]
        return Reading(counts[0], counts[1], moving, now_s, tuple(self._complaints(now_s)))

    def _complaints(self, now_s: float) -> Iterator[str]:
        """What the head itself reports as wrong."""
        for name, axis in zip(("pan", "tilt"), self._axes, strict=True):
            if axis.pressing(now_s):
                yield f"{name}: overload"
            if axis.supply(now_s) < LOWEST_SUPPLY:
                yield f"{name}: input voltage {axis.supply(now_s):.0%} of what it should be"
            if axis.temperature_c(now_s) > HOTTEST_C:
                yield f"{name}: overheating, {axis.temperature_c(now_s):.0f} °C"

    def _absurd(self, fault: Fault) -> float:
        """One of the angles that a head full of garbage reports."""
        kind, value = self._faults.draw(fault), self._faults.draw(fault)
        if kind < 0.4:
            return math.nan
        return (2 * value - 1) * (1e6 if kind < 0.6 else math.pi)

    def _call(self, action: Callable[[float], _T]) -> _T:
        """Do what a caller requests, at the moment of the call; then let the answer fail if a fault says
        so."""
        faults, name = self._faults, self.head.name
        with self._lock:
            now_s = self._clock.now_s()
            for axis in self._axes:
                axis.follow(now_s)
            if self._closed:
                raise NoReply("it is closed", device=name)
            hung_up = faults.find(PAN_TILT, "hang_up", now_s)
            deaf = hung_up or faults.find(PAN_TILT, "off", now_s) or faults.strikes(PAN_TILT, now_s)
            if not deaf:
                result = action(now_s)
                silent = faults.takes(PAN_TILT, "mute", now_s) or faults.takes(PAN_TILT, "half", now_s)
                dead = any(axis.silent(now_s) for axis in self._axes)
                damaged = faults.takes(PAN_TILT, "corrupt", now_s) or faults.takes(PAN_TILT, "swapped", now_s)
                late = faults.find(PAN_TILT, "delayed", now_s) or faults.takes(PAN_TILT, "late", now_s)
        if hung_up:
            raise NoReply("the line is gone", device=name)
        wait_s = late.number("delay_s") if not deaf and late else 0.0
        if deaf or silent or dead or (late and late.word == "late" and wait_s > REPLY_TIMEOUT_S):
            self._clock.sleep(REPLY_TIMEOUT_S)
            raise NoReply(f"no answer within {REPLY_TIMEOUT_S:g} s", device=name)
        self._clock.sleep(wait_s)
        if damaged:
            raise BadReply(f"the answer was damaged ({damaged.word})", device=name)
        return result


def _axes(head: HeadModel, faults: FaultPanel, time_s: float, resumes: bool) -> tuple[WireAxis, WireAxis]:
    """Pan and tilt."""
    pan = WireAxis(head.pan, faults, number=0, time_s=time_s, resumes=resumes)
    return pan, WireAxis(head.tilt, faults, number=1, time_s=time_s, resumes=resumes)


class WiredHead:
    """Axes, the simulator that turns them, the line to it, and the real driver at its other end.

    The head's approach is done by the driver. Raises BadOptions for a head that has no such wire, and for a
    clock turned by hand; DriverError.
    """

    def __init__(self, wire: str, head: HeadModel, clock: Clock, faults: FaultPanel) -> None:
        check_head(wire, head)
        if not clock.runs:
            raise BadOptions(f"simulation.wire {wire!r} needs a clock that goes on by itself")
        now_s = clock.now_s()
        self._axes = _axes(head, faults, now_s, resumes=True)
        make = _dynamixel if wire == "dynamixel" else _flir_ptu
        device, open_head, options = make(WIRED_HEADS[head.name], head, self._axes, now_s)
        if head.pan.settle_s > 0:
            options["settle_s"] = head.pan.settle_s
        self.line = MemoryLine(device, clock, faults)
        try:
            self.pan_tilt: PanTilt = open_head({**options, "port": self.line.path}, clock, self.line.open)
        except BaseException:
            self.line.close()
            raise

    def true_joints(self, time_s: float) -> tuple[float, float]:
        """Return the mechanical pan and tilt at a moment of the last minute, radians. Never fails."""
        pan, tilt = self._axes
        return pan.mechanical_rad(time_s), tilt.mechanical_rad(time_s)

    def close(self) -> None:
        """Close the driver, then its line."""
        self.pan_tilt.close()
        self.line.close()


_Made = tuple[WireDevice, Callable[[Mapping[str, Any], Clock, OpenLine], PanTilt], dict[str, Any]]


def _dynamixel(kind: WireModel, head: HeadModel, axes: tuple[WireAxis, WireAxis], time_s: float) -> _Made:
    """Two servos at 1 Mbaud, ids 1 and 2."""
    from drivers.dynamixel.head import open_head

    baud = 1_000_000
    servos = [
        SimulatedServo(
            kind.simulated,
            servo_id,
            axis,
            settings={"baud_rate": BAUD_RATES.index(baud), "return_delay_time": 0},
            time_s=time_s,
        )
        for servo_id, axis in enumerate(axes, 1)
    ]
    speed_rad_per_s = head.pan.speed_rad_per_s
    options: dict[str, Any] = {
        "baud": baud,
        "reply_timeout_s": 0.25,  # as long as the process may be silent
        "speed_rad_per_s": speed_rad_per_s,
        "acceleration_rad_per_s2": max(head.pan.acceleration_rad_per_s2, speed_rad_per_s / _BRAKING_S),
        "watchdog_s": _WATCHDOG_S,
    }
    for servo_id, (name, axis) in enumerate((("pan", head.pan), ("tilt", head.tilt)), 1):
        # Rebooted by itself, so that a fault that was taken back leaves nothing behind; nothing falls here.
        options[name] = {"id": servo_id, "model": kind.driver_model, "on_hardware_error": "reboot"}
        options[name] |= _reach(axis)
    return DynamixelBus(servos), open_head, options


def _flir_ptu(kind: WireModel, head: HeadModel, axes: tuple[WireAxis, WireAxis], time_s: float) -> _Made:
    """A unit in eighth steps, which counts pan to the left."""
    from drivers.flir_ptu.head import open_head

    unit = SimulatedPtu(kind.simulated, *axes, step_mode="E", baud=38400)
    pan, tilt = {**_reach(head.pan), "sign": -1}, {**_reach(head.tilt), "sign": 1}
    # The acceleration stays the unit's own: to set it takes the unit seconds.
    speed = {"speed_rad_per_s": head.pan.speed_rad_per_s}
    return unit, open_head, {"baud": unit.baud, "pan": pan, "tilt": tilt, **speed}


def _reach(axis: AxisSettings) -> dict[str, Any]:
    """Limits and approach of an axis as the driver's options have them."""
    reach: dict[str, Any] = {"limits_rad": [axis.low_rad + _MARGIN_RAD, axis.high_rad - _MARGIN_RAD]}
    if axis.approach_rad > 0:
        hangs = axis.gravity_friction < 1
        reach |= {"approach": "gravity" if hangs else "positive", "approach_rad": axis.approach_rad}
        reach |= {"gravity_turnover_rad": axis.gravity_turnover_rad} if hangs else {}
    return reach
