"""A simulated head behind bytes: a simulator at one end of a line in memory, the real driver at the other.

The simulated rover uses it where a configuration says ``simulation.wire``. The cameras look from the axes of
the simulator, so what they show followed from the bytes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from drivers.clock import Clock
from drivers.errors import BadOptions
from drivers.faults import FaultPanel
from drivers.interfaces import PanTilt
from drivers.serial_line import OpenLine
from drivers.sim.axis import AxisSettings
from drivers.sim.pan_tilt import PRESETS, HeadSettings
from drivers.sim.wire.axis import WireAxis
from drivers.sim.wire.carrier import WireDevice
from drivers.sim.wire.dynamixel_bus import DynamixelBus
from drivers.sim.wire.dynamixel_registers import BAUD_RATES
from drivers.sim.wire.dynamixel_servo import SimulatedServo
from drivers.sim.wire.memory_line import MemoryLine
from drivers.sim.wire.ptu import SimulatedPtu

_MARGIN_RAD = math.radians(0.5)
"""How far inside the simulator's own range the driver's limits are."""

_WATCHDOG_S, _BRAKING_S = 0.38, 0.095
"""On the machine's clock renderer, simulator and driver share one process, which on a busy machine is silent
for 0.3 s now and then. So the servos wait longer than usual, and brake harder, since they must stand 0.5 s
after the last packet."""


@dataclass(frozen=True)
class _Wire:
    """What stands behind a head of a name: which simulator's model, and which the driver is told."""

    wire: str
    simulated: str
    driver_model: str = ""


_HEADS: Mapping[str, _Wire] = MappingProxyType(
    {
        "dynamixel_x": _Wire("dynamixel", "xm430_w350", "XM430-W350"),
        "ph42": _Wire("dynamixel", "ph42_020_s300", "PH42-020-S300"),
        "ptu_d46_70": _Wire("flir_ptu", "d46_70"),
    }
)

DEFAULT_HEADS: Mapping[str, str] = MappingProxyType({"dynamixel": "dynamixel_x", "flir_ptu": "ptu_d46_70"})
"""The wires there are, and the head behind each where a configuration names none."""


def check_head(wire: str, head: HeadSettings) -> None:
    """Pass a head that can stand behind a wire. Raises BadOptions, naming those that can."""
    fitting = [name for name, one in _HEADS.items() if one.wire == wire]
    if head.name not in fitting:
        raise BadOptions(
            f"simulation.head is {head.name!r}, which is not behind simulation.wire {wire!r}; "
            f"expected {' or '.join(fitting)}"
        )
    preset = PRESETS[head.name]
    if head.pan.count_rad != preset.pan.count_rad or head.tilt.count_rad != preset.tilt.count_rad:
        raise BadOptions(
            f"simulation.head.count_rad cannot be changed behind simulation.wire {wire!r}: the device has it"
        )


class WiredHead:
    """Axes, the simulator that turns them, the line to it, and the real driver at its other end.

    Parameters
    ----------
    wire
        A key of ``DEFAULT_HEADS``.
    head
        What it is made of; its approach is done by the driver.
    clock
        What simulator, line and driver live on: the machine's own or the simulation's, none turned by hand.
    faults
        Those of ``pan_tilt`` act on the axes and on the line.

    Attributes
    ----------
    pan_tilt
        The real driver.
    line
        What it talks over.

    Raises
    ------
    BadOptions
        For a head or clock that this cannot be done with.
    DriverError
        As the driver when it is opened.
    """

    def __init__(self, wire: str, head: HeadSettings, clock: Clock, faults: FaultPanel) -> None:
        check_head(wire, head)
        if not clock.runs:
            raise BadOptions(f"simulation.wire {wire!r} needs a clock that goes on by itself")
        now_s = clock.now_s()
        self._axes = (
            WireAxis(head.pan, faults, number=0, time_s=now_s),
            WireAxis(head.tilt, faults, number=1, time_s=now_s),
        )
        make = _dynamixel if wire == "dynamixel" else _flir_ptu
        device, open_head, options = make(_HEADS[head.name], head, self._axes, now_s)
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


def _dynamixel(kind: _Wire, head: HeadSettings, axes: tuple[WireAxis, WireAxis], time_s: float) -> _Made:
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


def _flir_ptu(kind: _Wire, head: HeadSettings, axes: tuple[WireAxis, WireAxis], time_s: float) -> _Made:
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
