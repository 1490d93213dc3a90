"""A real head, made ready for the checks of heads over all of its configuration's limits."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from drivers.hardware import DeviceSettings
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
    options = settings.options
    if settings.driver == "dynamixel":
        from drivers.dynamixel.link import Link
        from drivers.dynamixel.workshop import facts

        link = Link(options["port"], options.get("baud", 1_000_000))
        try:
            found = {name: facts(link, options[name]["id"]).values for name in ("pan", "tilt")}
        finally:
            link.close()
        return {name: values["hardware_error"] for name, values in found.items() if values["hardware_error"]}
    return {}  # a PTU has none: what it says by itself (!P, !T) is in the last reading's faults
