"""Records as plain JSON."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from typing import Any


def as_json(value: Any) -> Any:
    """Return dataclasses, arrays and tuples as plain JSON values; numbers that are not finite become null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: as_json(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {readable(str(key)): as_json(entry) for key, entry in value.items()}
    if type(value).__module__ == "numpy":  # an array or a scalar; NumPy is not loaded for that
        return as_json(value.tolist())
    if isinstance(value, (list, tuple, set, frozenset)):
        return [as_json(entry) for entry in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (int, bool)):
        return value
    return readable(str(value))


def readable(text: str) -> str:
    """Return a text that JSON and every terminal can hold.

    A byte outside UTF-8, which the name of a file may have, is written ``\\udcff``.
    """
    return text if text.isascii() else text.encode("utf-8", "backslashreplace").decode()


TOO_DEEP = "nested too deeply to be shown"


def writable(value: Any) -> Any:
    """Return a value as JSON holds it: itself if it does, else as `as_json` has it."""
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError, RecursionError):
        try:
            return as_json(value)
        except RecursionError:
            return TOO_DEEP
    return value
