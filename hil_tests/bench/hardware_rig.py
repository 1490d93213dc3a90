"""A real head, made ready for the checks of heads over all of its configuration's limits."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from drivers.dynamixel import workshop as dynamixel
from drivers.dynamixel.link import Link
from drivers.dynamixel.models import dynamixel_settings
from drivers.feetech import servos as feetech
from drivers.feetech.head import feetech_settings
from drivers.feetech.servos import FeetechLink
from drivers.hardware import DeviceSettings
from mastctl.config import load_config
from mastctl.service.masts import bounds_of
from mastctl.testing.drivers.plugin import head_under_test
from mastctl.testing.drivers.test_head import HeadTrial

READERS: dict[str, Any] = {"dynamixel": dynamixel_settings, "feetech": feetech_settings}
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
    if settings.driver not in READERS:
        return {}  # a PTU's !P and !T are in the last reading's faults
    options: Any = READERS[settings.driver](settings.options)
    ids = {"pan": options.pan.servo_id, "tilt": options.tilt.servo_id}
    if settings.driver == "dynamixel":
        with closing(Link(options.port, options.baud)) as link:
            found = {name: dynamixel.facts(link, n).values["hardware_error"] for name, n in ids.items()}
    else:
        with closing(FeetechLink(options.port, options.baud)) as line:
            found = {name: feetech.facts(line, n).values["status"] for name, n in ids.items()}
    return {name: value for name, value in found.items() if value}
