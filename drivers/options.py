"""The options of a driver, and the settings of a simulation, as a configuration gives them: read strictly.

The options of a camera's driver are a `DriverOptions`: its fields state keys, types, bounds, defaults and
descriptions once, for the check, the sentence of a refusal and the JSON Schema (`calib.files.records`).
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, TypeGuard, TypeVar

from pydantic import AfterValidator, ConfigDict
from pydantic_core import CoreSchema
from pydantic_core.core_schema import no_info_plain_validator_function

from calib.errors import BadFile
from calib.files.records import Record, problem, read_record
from drivers.errors import BadOptions
from drivers.faults import nearest

_KINDS = {bool: "true or false", tuple: "a list", str: "text"}


def is_number(value: object) -> TypeGuard[int | float]:
    """Return whether a value is a finite number and not a truth value."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return abs(value) <= sys.float_info.max


def is_whole(value: object) -> TypeGuard[int]:
    """Return whether a value is a whole number and not a truth value."""
    return isinstance(value, int) and not isinstance(value, bool)


class DriverOptions(Record):
    """The options of one driver; a key that is left out or null has its default."""

    model_config = ConfigDict(use_attribute_docstrings=True)


D = TypeVar("D", bound=DriverOptions)


def read_options(kind: type[D], options: Mapping[str, Any], device: str = "") -> D:
    """Return a driver's options. Raises BadOptions with the place, the value and what would be right."""
    try:
        return read_record(kind, dict(options), "")
    except BadFile as error:
        place = f"options.{error.place}" if error.place else "options"
        raise BadOptions(f"{place}: {error.reason}", device=device) from None


def one_of(known: Iterable[str]) -> AfterValidator:
    """Return what passes the names that a driver knows, and refuses another with the nearest of them."""

    def check(name: str) -> str:
        if name not in known:
            raise problem("", f"{name!r}, which this driver does not read{nearest(name, known)}")
        return name

    return AfterValidator(check)


def named_values(is_name: Callable[[str], bool], kinds: tuple[type, ...], expected: str) -> Any:
    """Return what annotates a mapping of names to values of a few kinds."""

    def check(values: dict[str, Any]) -> dict[str, Any]:
        for name, value in values.items():
            if not is_name(name) or not isinstance(value, kinds) or value != value:
                raise problem(name, f"{value!r}, expected {expected}")
        return values

    return AfterValidator(check)


@dataclass(frozen=True)
class TwoWholes:
    """Annotates a pair of whole numbers within bounds, such as a picture's size."""

    low: int
    high: int

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> CoreSchema:
        return no_info_plain_validator_function(self._check)

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        items = {"type": "integer", "minimum": self.low, "maximum": self.high}
        return {"type": "array", "minItems": 2, "maxItems": 2, "items": items}

    def _check(self, value: Any) -> tuple[int, int]:
        two = list(value) if isinstance(value, list | tuple) else []
        if len(two) != 2 or not all(is_whole(one) and self.low <= one <= self.high for one in two):
            raise problem("", f"{value!r}, expected two whole numbers from {self.low} to {self.high}")
        return two[0], two[1]


def check_in_frame(key: str, exposure_s: float | None, rate_hz: float | None) -> None:
    """Refuse, in a validator, an exposure time for which a camera would have to stretch its frames."""
    if exposure_s is not None and rate_hz is not None and exposure_s > 1 / rate_hz:
        words = f"{exposure_s:g} s, longer than a frame at rate_hz {rate_hz:g} ({1 / rate_hz:.4g} s)"
        raise problem(key, f"{words}; a shorter one, or a lower rate, is expected")


class OptionReader:
    """One mapping of options; a refusal names the key, the value and what would be right.

    Raises BadOptions if a key is unknown or missing; its methods raise it for a value that cannot be.

    Parameters
    ----------
    place
        The text before a key in a refusal, such as ``options.pan.``.
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
        """Return the refusal of a key, in words that follow its name."""
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

    def wholes(self, key: str, count: int, low: int, high: int) -> Any:
        """Return ``count`` whole numbers within bounds, None where the key is left out."""
        if key not in self.values:
            return None
        value = self.values[key]
        right = isinstance(value, list | tuple) and all(is_whole(one) and low <= one <= high for one in value)
        if not right or len(value) != count:
            raise self.bad(key, f"{count} whole numbers from {low} to {high}")
        return tuple(value)

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
