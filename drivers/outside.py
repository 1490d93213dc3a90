"""A device whose driver is not in this repository, by the name of its factory: ``package.module:factory``.

Foreign code may do anything while it is imported and called: one sentence tells it.
"""

from __future__ import annotations

from typing import Any

from drivers.errors import BadOptions, DriverError
from drivers.factory import named_factory, one_line
from drivers.hardware import DeviceSettings


def device_from_outside(name: str, device: DeviceSettings, protocol: type) -> Any:
    """A device made by a factory that is not in this repository."""
    factory = named_factory("driver", device.driver, name)
    try:
        made = factory(**device.options)
    except DriverError:
        raise
    except (Exception, SystemExit) as error:  # a foreign factory may raise anything: one sentence tells it
        raise BadOptions(
            f"driver {device.driver!r} refuses the options {dict(device.options)!r} ({one_line(error)})",
            device=name,
        ) from error
    wanted = [m for m in ("read", "move", "stop", "next_frame", "close") if hasattr(protocol, m)]
    missing = [method for method in wanted if not callable(getattr(made, method, None))]
    if missing:
        raise BadOptions(
            f"driver {device.driver!r} made a {type(made).__name__} without {', '.join(missing)}", device=name
        )
    return made
