"""Which drivers there are, and what their names alone tell: a configuration's clock and its head."""

from __future__ import annotations

import json

from drivers.clock import Clock, SystemClock
from drivers.errors import BadOptions
from drivers.faults import PAN_TILT
from drivers.hardware import HardwareSettings
from drivers.serial_line import stable_name
from drivers.simulation_clock import SimulationClock, simulation_speed

HEADS = {"dynamixel": "drivers.dynamixel.head", "flir_ptu": "drivers.flir_ptu.head"}
"""Pan/tilt drivers of this repository: the module whose ``open_head(options, clock)`` opens them, and whose
``halt(options)`` stops a head that no daemon drives any more."""

CAMERAS = {"v4l2": "drivers.v4l2.camera"}
"""Camera drivers of this repository: the module whose ``open_camera(options, clock, name)`` opens one."""

OURS = ("sim", "replay")
"""No device behind them: they neither fail for a moment nor block, and live on any clock."""

BUILT_IN = (*HEADS, *CAMERAS, *OURS)


def clock_for(settings: HardwareSettings) -> Clock:
    """Return the clock that these devices live on: the simulation's, if it is not to go as life does.

    Raises
    ------
    BadOptions
        If a speed is asked for that is none, or that a device cannot follow: real ones and those from outside
        live in real time.
    """
    speed = simulation_speed(settings.simulation.get("speed", 1.0))
    if speed == 1.0:
        return SystemClock()
    told = f"simulation.speed is {settings.simulation['speed']}, expected 1:"
    for name, device in {PAN_TILT: settings.pan_tilt, **settings.cameras}.items():
        if device.driver not in OURS:
            raise BadOptions(f"{told} driver {device.driver!r} lives in real time", device=name)
    return SimulationClock(speed)


def head_name(settings: HardwareSettings) -> str | None:
    """Return which head the settings drive, whoever wrote them: None for one in this program's memory.

    A head is its line (`drivers.serial_line.stable_name` of the option ``port``); one from outside without
    such an option is its factory with all options.
    """
    device = settings.pan_tilt
    outside = ":" in device.driver
    if device.driver not in HEADS and not outside:
        return None
    port = device.options.get("port")
    if isinstance(port, str) and port:
        return stable_name(port)
    if outside:
        return f"{device.driver} {json.dumps(dict(device.options), sort_keys=True, default=str)}"
    return None
