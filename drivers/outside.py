"""Devices and scenes that are not in this repository, by the name of a factory: ``package.module:factory``.

Foreign code may do anything while it is imported and called: one sentence reports it.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any

from drivers.errors import BadOptions, DriverError


def device_from_outside(name: str, driver: str, options: Mapping[str, Any], protocol: type) -> Any:
    """Return a device made by a factory that is not in this repository.

    Parameters
    ----------
    name
        The device's, in messages.
    driver, options
        The factory and its keywords.
    protocol
        The Protocol of the device: `drivers.interfaces.PanTilt` or `drivers.interfaces.Camera`.

    Raises
    ------
    BadOptions
        If there is no such factory, it refuses the options, or what it makes lacks a method.
    DriverError
        From the factory, as it is.
    """
    factory = named_factory("driver", driver, name)
    try:
        made = factory(**options)
    except DriverError:
        raise
    except (Exception, SystemExit) as error:  # a foreign factory may raise anything: one sentence tells it
        raise BadOptions(
            f"driver {driver!r} refuses the options {dict(options)!r} ({one_line(error)})", device=name
        ) from error
    wanted = [m for m in ("read", "move", "stop", "next_frame", "close") if hasattr(protocol, m)]
    missing = [method for method in wanted if not callable(getattr(made, method, None))]
    if missing:
        raise BadOptions(
            f"driver {driver!r} made a {type(made).__name__} without {', '.join(missing)}", device=name
        )
    return made


def named_factory(what: str, name: str, device: str = "") -> Callable[..., Any]:
    """Return the callable that ``package.module:factory`` names.

    Parameters
    ----------
    what
        ``driver`` or ``scene``, for messages.
    name
        As a configuration has it.
    device
        Put before a message.

    Raises
    ------
    BadOptions
        If there is no such module, or nothing in it that can be called by that name.
    """
    module_name, _, attribute = name.partition(":")
    try:
        found: Any = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # whatever a foreign module does while it is imported
        raise BadOptions(
            f"{what} {name!r}: cannot import {module_name!r} ({one_line(error)})", device=device
        ) from error
    for part in attribute.split("."):
        if not hasattr(found, part):
            raise BadOptions(f"{what} {name!r}: {module_name!r} has no {attribute!r}", device=device)
        found = getattr(found, part)
    if not callable(found):
        raise BadOptions(f"{what} {name!r}: {attribute!r} cannot be called", device=device)
    factory: Callable[..., Any] = found
    return factory


def one_line(error: BaseException) -> str:
    """Return a foreign error as one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())
