"""A part of the ``simulation`` section that is a dataclass of plain values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

from drivers.errors import BadOptions
from drivers.faults import nearest
from drivers.options import is_number, is_whole

_KINDS = {bool: "true or false", tuple: "a list", str: "text"}


def filled(defaults: Any, values: Any, key: str) -> Any:
    """Return a settings dataclass with values replaced by those of a mapping. Raises BadOptions."""
    if not isinstance(values, Mapping):
        raise BadOptions(f"{key} is {values!r}, expected keys and values")
    known = {f.name: getattr(defaults, f.name) for f in fields(defaults)}
    changes: dict[str, Any] = {}
    for name, value in values.items():
        if name not in known:
            raise BadOptions(f"{key} has no key {name!r}{nearest(str(name), known)}")
        kind = type(known[name])
        if is_dataclass(known[name]):
            value = filled(known[name], value, f"{key}.{name}")
        elif kind in (int, float):
            if not (is_whole(value) if kind is int else is_number(value)):
                what = "a whole number" if kind is int else "a number"
                raise BadOptions(f"{key}.{name} is {value!r}, expected {what}")
            value = kind(value)
        elif not isinstance(value, kind):
            raise BadOptions(f"{key}.{name} is {value!r}, expected {_KINDS.get(kind, kind.__name__)}")
        changes[str(name)] = value
    return replace(defaults, **changes)


def check_bounds(settings: Any, bounds: Mapping[str, tuple[float, float]], key: str) -> None:
    """Pass numbers that lie within their bounds. Raises BadOptions with the first that does not."""
    for name, (low, high) in bounds.items():
        value = getattr(settings, name)
        if not low <= value <= high:
            raise BadOptions(f"{key}.{name} is {value!r}, expected a number from {low:g} to {high:g}")
