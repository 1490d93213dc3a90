"""A real head, made ready for the checks of heads over all of its configuration's limits."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from drivers.dynamixel import workshop as dynamixel
from drivers.dynamixel.link import Link
from drivers.feetech import workshop as feetech
from drivers.feetech.link import FeetechLink, open_link
from drivers.hardware import DeviceSettings, head_options
from mastctl.config import load_config
from mastctl.conform.devices import head_under_test
from mastctl.conform.head_trial import HeadTrial
from mastctl.service.masts import bounds_of

CHOSEN: str | None = None
"""The configuration that --hardware names."""


@contextmanager
def hardware_trial(file: Path) -> Iterator[HeadTrial]:
    """The head of a configuration, standing in the middle of its limits."""
    config = load_config(file)
    speed = config.limits.speed_rad_per_s
    with head_under_test(config.hardware, bounds_of(config), math.inf, speed, None, moves=True) as trial:
        trial.sent(trial.goal(0.0, 0.0))
        yield trial


def error_registers(settings: DeviceSettings) -> dict[str, Any]:
    """What the device itself has noted as wrong, by name; the head has to be closed."""
    if settings.driver not in ("dynamixel", "feetech"):
        return {}  # a PTU's !P and !T are in the last reading's faults; a VISCA or Pelco head notes nothing
    options = head_options(settings)
    link: Link | FeetechLink
    if settings.driver == "dynamixel":
        link, register, facts = Link(options.port, options.baud), "hardware_error", dynamixel.facts
    else:
        link, register, facts = open_link(options.port, options.baud), "status", feetech.facts
    with closing(link):
        axes = {"pan": options.pan, "tilt": options.tilt}
        found = {name: facts(link, axis.servo_id).values[register] for name, axis in axes.items()}
    return {name: value for name, value in found.items() if value}
