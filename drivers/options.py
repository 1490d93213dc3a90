"""The options of a driver, and the settings of a simulation, as a configuration gives them: read strictly.

The options of a driver are a `DriverOptions`: its fields state keys, types, bounds, defaults and descriptions
once, for the check, the sentence of a refusal and the JSON Schema (`calib.files.records`).
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeGuard, TypeVar

from pydantic import AfterValidator, ConfigDict, Field
from pydantic_core import CoreSchema
from pydantic_core.core_schema import no_info_after_validator_function, no_info_plain_validator_function

from calib.errors import BadFile
from calib.files.records import Record, problem, read_record
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


class DriverOptions(Record):
    """The options of one driver; a key that is left out or null has its default."""

    model_config = ConfigDict(use_attribute_docstrings=True)


D = TypeVar("D", bound=DriverOptions)


def read_options(
    kind: type[D], options: Mapping[str, Any], device: str = "", place: str = "options", folder: Path = Path()
) -> D:
    """Return a driver's options. Raises BadOptions with the place, the value and what would be right."""
    try:
        return read_record(kind, dict(options), folder / place, place)
    except BadFile as error:
        raise BadOptions(f"{error.place}: {error.reason}", device=device) from None


def one_of(known: Collection[Any]) -> AfterValidator:
    """Return what passes the values that a driver knows, and refuses another with the nearest name or all."""

    def check(value: Any) -> Any:
        if value not in known:
            hint = (
                nearest(value, known)
                if isinstance(value, str)
                else f"; there is {', '.join(map(str, known))}"
            )
            raise problem("", f"{value!r}, which this driver does not know{hint}")
        return value

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
class ReadBy:
    """Annotates a value that a function reads, which raises `problem`, or BadOptions with the whole place."""

    function: Callable[[Any], Any]
    schema: Mapping[str, Any] = field(default_factory=dict, hash=False)

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> CoreSchema:
        return no_info_plain_validator_function(self.function)

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        return dict(self.schema)


def wholes(count: int, low: int, high: int) -> ReadBy:
    """Return what annotates some whole numbers within bounds, such as a picture's size."""

    def check(value: Any) -> tuple[int, ...]:
        found = tuple(value) if isinstance(value, list | tuple) else ()
        if len(found) != count or not all(is_whole(one) and low <= one <= high for one in found):
            raise problem("", f"{value!r} where {count} whole numbers from {low} to {high} are expected")
        return found

    items = {"type": "integer", "minimum": low, "maximum": high}
    return ReadBy(check, {"type": "array", "minItems": count, "maxItems": count, "items": items})


@dataclass(frozen=True)
class Ascending:
    """Annotates ``[low, high]``, the lower first, both within bounds."""

    low: float = -1e9
    high: float = 1e9

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> CoreSchema:
        number = Annotated[float, Field(ge=self.low, le=self.high)]
        two = handler.generate_schema(Annotated[list[number], Field(min_length=2, max_length=2)])
        return no_info_after_validator_function(self._check, two)

    @staticmethod
    def _check(two: list[float]) -> tuple[float, float]:
        if not two[0] < two[1]:
            raise problem("", f"{two} where [low, high] with low below high is expected")
        return float(two[0]), float(two[1])


def check_in_frame(key: str, exposure_s: float | None, rate_hz: float | None) -> None:
    """Refuse, in a validator, an exposure time for which a camera would have to stretch its frames."""
    if exposure_s is not None and rate_hz is not None and exposure_s > 1 / rate_hz:
        message = f"{exposure_s:g} s, longer than a frame at rate_hz {rate_hz:g} ({1 / rate_hz:.4g} s)"
        raise problem(key, f"{message}; a shorter one, or a lower rate, is expected")
