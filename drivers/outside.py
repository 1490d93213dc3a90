"""A device whose driver is not in this repository, by the name of its factory: ``package.module:factory``.

Foreign code may do anything while it is imported and called: one sentence tells it.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from drivers.errors import BadOptions, DriverError
from drivers.hardware import DeviceSettings


def device_from_outside(name: str, device: DeviceSettings, protocol: type) -> Any:
    """A device made by a factory that is not in this repository."""
    factory = _factory(name, device.driver)
    try:
        made = factory(**device.options)
    except DriverError:
        raise
    except (Exception, SystemExit) as error:  # a foreign factory may raise anything: one sentence tells it
        raise BadOptions(
            f"driver {device.driver!r} refuses the options {dict(device.options)!r} ({_one_line(error)})",
            device=name,
        ) from error
    wanted = [m for m in ("read", "move", "stop", "next_frame", "close") if hasattr(protocol, m)]
    missing = [method for method in wanted if not callable(getattr(made, method, None))]
    if missing:
        raise BadOptions(
            f"driver {device.driver!r} made a {type(made).__name__} without {', '.join(missing)}", device=name
        )
    return made


def _factory(name: str, driver: str) -> Callable[..., Any]:
    """The callable that ``package.module:factory`` names."""
    module_name, _, attribute = driver.partition(":")
    try:
        found: Any = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # whatever a foreign module does while it is imported
        raise BadOptions(
            f"driver {driver!r}: cannot import {module_name!r} ({_one_line(error)})", device=name
        ) from error
    for part in attribute.split("."):
        if not hasattr(found, part):
            raise BadOptions(f"driver {driver!r}: {module_name!r} has no {attribute!r}", device=name)
        found = getattr(found, part)
    if not callable(found):
        raise BadOptions(f"driver {driver!r}: {attribute!r} cannot be called", device=name)
    factory: Callable[..., Any] = found
    return factory


def _one_line(error: BaseException) -> str:
    """An error as one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())
