"""The options of a driver as a configuration gives them, read key by key and strictly."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from typing import Any, TypeGuard

from drivers.errors import BadOptions
from drivers.faults import nearest


def is_number(value: object) -> TypeGuard[int | float]:
    """Return whether a value is a finite number and not a truth value."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return abs(value) <= sys.float_info.max


def is_whole(value: object) -> TypeGuard[int]:
    """Return whether a value is a whole number and not a truth value."""
    return isinstance(value, int) and not isinstance(value, bool)


class OptionReader:
    """One mapping of options; whatever it refuses is told with the key, the value and what would be right.

    Parameters
    ----------
    values
        What the configuration holds.
    known, needed
        The keys that may, and that must, be there.
    place
        What stands before a key in a refusal, such as ``options.pan.``.
    device
        The device's name in refusals.

    Raises
    ------
    BadOptions
        If a key is unknown or missing; its methods raise it for a value that cannot be.
    """

    def __init__(
        self,
        values: Mapping[str, Any],
        known: Iterable[str],
        needed: Iterable[str] = (),
        place: str = "options.",
        device: str = "",
    ) -> None:
        self.values = values
        self._place = place
        self._device = device
        known = tuple(known)
        for key in values:
            if key not in known:
                raise self.refused(key, f": there is no such option{nearest(str(key), known)}")
        for key in needed:
            if key not in values:
                raise self.refused(key, " is missing")

    def bad(self, key: str, expected: str) -> BadOptions:
        """Return the refusal of a key's value."""
        return self.refused(key, f" is {self.values.get(key)!r}, expected {expected}")

    def refused(self, key: str, words: str) -> BadOptions:
        """Return the refusal of a key, told in words that follow its name."""
        return BadOptions(f"{self._place}{key}{words}", device=self._device)

    def section(
        self, key: str, expected: str, known: Iterable[str], needed: Iterable[str] = ()
    ) -> OptionReader:
        """Return the reader of the mapping that a key holds."""
        value = self.values[key]
        if not isinstance(value, Mapping):
            raise self.bad(key, expected)
        return OptionReader(value, known, needed, f"{self._place}{key}.", self._device)

    def text(self, key: str, expected: str, default: Any = None) -> Any:
        """Return a text that is not blank, or the default where the key is left out."""
        if key not in self.values:
            return default
        value = self.values[key]
        if not isinstance(value, str) or not value.strip():
            raise self.bad(key, expected)
        return value

    def number(self, key: str, default: Any, low: float, high: float) -> Any:
        """Return a number within bounds, or the default, which may be None, where the key is left out."""
        if key not in self.values:
            return default
        value = self.values[key]
        if not is_number(value) or not low <= value <= high:
            raise self.bad(key, f"a number from {low:g} to {high:g}")
        return float(value)

    def whole(self, key: str, default: Any, low: int, high: int) -> Any:
        """Return a whole number within bounds, or the default where the key is left out."""
        if key not in self.values:
            return default
        value = self.values[key]
        if not is_whole(value) or not low <= value <= high:
            raise self.bad(key, f"a whole number from {low} to {high}")
        return value

    def flag(self, key: str, default: bool) -> bool:
        """Return a truth value."""
        value = self.values.get(key, default)
        if not isinstance(value, bool):
            raise self.bad(key, "true or false")
        return value

    def one_of(self, key: str, default: Any, allowed: tuple[Any, ...], between: str = " or ") -> Any:
        """Return one of a few values; ``between`` stands between them in a refusal."""
        value = self.values.get(key, default)
        if isinstance(value, bool) or value not in allowed:
            raise self.bad(key, between.join(str(one) for one in allowed))
        return allowed[allowed.index(value)]  # 1 for 1.0

    def pair(self, key: str, expected: str) -> tuple[float, float]:
        """Return two numbers."""
        value = self.values[key]
        if not isinstance(value, list | tuple) or len(value) != 2 or not all(is_number(one) for one in value):
            raise self.bad(key, expected)
        return float(value[0]), float(value[1])
