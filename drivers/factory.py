"""A thing that is not in this repository, by the name of its factory: ``package.module:factory``.

Foreign code may do anything while it is imported: one sentence tells it.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from drivers.errors import BadOptions


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
