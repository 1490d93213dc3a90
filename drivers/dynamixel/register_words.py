"""What a register's number means, for people."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from drivers.dynamixel.models import BAUD_RATES, OPERATING_MODES, Model, hardware_error_words

NO_SECONDARY_ID = 253  # and above
Words = Callable[[Model, int], str]


def register_words(model: Model, name: str, value: int) -> str:
    """Return what a register's number means; empty where the number says it."""
    words = _WORDS.get(name)
    return "" if words is None else words(model, value)


def _angle(model: Model, value: int) -> str:
    return f"{math.degrees((value - model.centre_count) * model.count_rad):.3f} deg from its middle"


def _velocity(model: Model, value: int) -> str:
    return f"{value * model.velocity_unit_rad_per_s:.4f} rad/s"


def _acceleration(model: Model, value: int) -> str:
    return f"{value * model.acceleration_unit_rad_per_s2:.4f} rad/s2" if value else "as hard as it can"


def _current(model: Model, value: int) -> str:
    return "" if model.current_unit_A is None else f"{value * model.current_unit_A:.3f} A"


def _load(model: Model, value: int) -> str:
    return f"{value / 10:.1f} % load" if model.current_unit_A is None else _current(model, value)


def _volts(model: Model, value: int) -> str:
    return f"{value / 10:.1f} V"


def _errors(model: Model, value: int) -> str:
    return ", ".join(hardware_error_words(value)) or "none"


_WORDS: Mapping[str, Words] = {
    "model_number": lambda model, value: model.name,
    "baud": lambda model, value: f"{BAUD_RATES[value]} baud" if value in BAUD_RATES else "unknown baud rate",
    "return_delay": lambda model, value: f"{2 * value} us",
    "operating_mode": lambda model, value: OPERATING_MODES.get(value, "unknown mode"),
    "secondary_id": lambda model, value: "none" if value >= NO_SECONDARY_ID else "also obeys this id",
    "min_position_limit": _angle,
    "max_position_limit": _angle,
    "present_position": _angle,
    "goal_position": _angle,
    "position_trajectory": _angle,
    "homing_offset": lambda model, value: f"{math.degrees(value * model.count_rad):.3f} deg",
    "velocity_limit": _velocity,
    "goal_velocity": _velocity,
    "profile_velocity": lambda model, value: _velocity(model, value) if value else "as fast as it can",
    "present_velocity": _velocity,
    "velocity_trajectory": _velocity,
    "moving_threshold": _velocity,
    "profile_acceleration": _acceleration,
    "current_limit": _current,
    "goal_current": _current,
    "present_current": _load,
    "max_voltage_limit": _volts,
    "min_voltage_limit": _volts,
    "present_voltage": _volts,
    "temperature_limit": lambda model, value: f"{value} C",
    "present_temperature": lambda model, value: f"{value} C",
    "hardware_error": _errors,
    "shutdown": lambda model, value: f"shuts down on: {_errors(model, value)}",
    "bus_watchdog": lambda model, value: {0: "off", 255: "tripped"}.get(value, f"{20 * value} ms"),
    "torque_enable": lambda model, value: "on" if value else "off",
    "status_return_level": lambda model, value: {
        0: "answers pings",
        1: "answers reads",
        2: "answers everything",
    }.get(value, "unknown"),
    "moving_status": lambda model, value: "in position" if value & 1 else "not in position",
}
