"""What a reader asks of a file while it reads one: keys, kinds, bounds, choices, defaults, as a JSON Schema.

`watched` lets the strict readers (`calib.files.yaml_text.Section`, `drivers.options.OptionReader`) read an
example, and notes each question. What a reader looks at by hand is told beside it, by `Noted.tell`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

from calib.files.yaml_text import Section
from drivers.options import OptionReader

Schema = dict[str, Any]
MISSING: Any = object()


@dataclass
class Noted:
    """One key of a file: what its value must be, and the keys in it."""

    value: Schema = field(default_factory=dict)
    keys: dict[str, Noted] = field(default_factory=dict)
    required: list[str] = field(default_factory=list)
    read: bool = False  # a mapping of known keys
    named: bool = False  # a mapping of any names

    def at(self, place: str) -> Noted:
        """Return the note of a place, made if it is new."""
        here = self
        for step in filter(None, re.split(r"\.|(?=\[)", place)):
            here = here.keys.setdefault("[]" if step.startswith("[") else step, Noted())
        return here

    def note(self, value: Schema) -> None:
        """Add what a reader asks of a value: where two readings differ, what either allows."""
        if not self.value:
            self.value = value
            return
        for key, widest in (("minimum", min), ("exclusiveMinimum", min), ("maximum", max)):
            if key in self.value and key in value:
                self.value[key] = widest(self.value[key], value[key])
            elif key in self.value:
                del self.value[key]
        if self.value.get("default", MISSING) != value.get("default", MISSING):
            self.value.pop("default", None)

    def tell(self, value: Schema) -> None:
        """Say what a reader looks at by hand."""
        self.value, self.keys, self.read, self.named = value, {}, False, False

    def schema(self) -> Schema:
        """Return the JSON Schema of what was noted."""
        if "[]" in self.keys:
            return {"type": "array", **self.value, "items": self.keys["[]"].schema()}
        if self.named and not self.read:
            inner = Noted()
            for one in self.keys.values():
                inner.merge(one)
            any_value = inner.schema() if self.keys else {}
            return {"type": "object", **({"additionalProperties": any_value} if any_value else {})}
        if not self.read:
            return self.value
        properties = {key: one.schema() for key, one in self.keys.items()}
        for key in self.required:
            properties[key].pop("default", None)
        needed = {"required": self.required} if self.required else {}
        return {"type": "object", "additionalProperties": False, **needed, "properties": properties}

    def merge(self, other: Noted) -> None:
        """Add another note of the same place."""
        if other.read:
            self.required = [key for key in other.required if key in self.required or not self.read]
        self.read, self.named = self.read or other.read, self.named or other.named
        if other.value:
            self.note(dict(other.value))
        for key, one in other.keys.items():
            self.keys.setdefault(key, Noted()).merge(one)


def number(low: float | None, high: float | None, default: Any = None, kind: str = "number") -> Schema:
    """Return the schema of a number within bounds."""
    told = {"minimum": low, "maximum": high, "default": default}
    return {
        "type": kind,
        **{key: value for key, value in told.items() if value not in (None, math.inf, -math.inf)},
    }


def vector(item: Schema, count: int) -> Schema:
    """Return the schema of a list of so many."""
    return {"type": "array", "minItems": count, "maxItems": count, "items": item}


TEXT: Schema = {"type": "string", "pattern": r"\S"}
FLAG: Schema = {"type": "boolean"}
ANY: Schema = {"type": "object"}

SECTION: Mapping[str, Callable[..., Schema]] = {
    "text": lambda: TEXT,
    "choice": lambda choices: {"enum": list(choices)},
    "number": lambda limit=1e9: number(-limit, limit),
    "between": lambda low, high, usual=None: number(low, high, usual),
    "positive": lambda most: {"type": "number", "exclusiveMinimum": 0, "maximum": most},
    "ends": lambda limit: vector(number(-limit, limit), 2),
    "integer": lambda low, high: number(low, high, kind="integer"),
    "integers": lambda count, low, high: vector(number(low, high, kind="integer"), count),
    "vector": lambda limit=1e9, count=3: vector(number(-limit, limit), count),
    "rows": lambda rows, columns, limit=1e9: vector(vector(number(-limit, limit), columns), rows),
    "pairs": lambda most, limit=1e9: {
        "type": "array",
        "maxItems": most,
        "items": vector(number(-limit, limit), 2),
    },
    "free": lambda: ANY,
}
"""What each question of a `Section` asks, by the arguments behind the key."""

OPTIONS: Mapping[str, Callable[..., Schema]] = {
    "text": lambda expected, default=None: {**TEXT, **({"default": default} if default else {})},
    "number": lambda default, low, high: number(low, high, default),
    "whole": lambda default, low, high: number(low, high, default, "integer"),
    "wholes": lambda count, low, high: vector(number(low, high, kind="integer"), count),
    "flag": lambda default: {**FLAG, "default": default},
    "one_of": lambda default, allowed, between="": {"enum": list(allowed), "default": default},
    "pair": lambda expected: vector({"type": "number"}, 2),
}
"""The same of an `OptionReader`."""


@contextmanager
def watched(before: str = "") -> Iterator[Noted]:
    """Note what is asked of a file; ``before`` stands before the keys of its places and is left out."""
    root, asks = Noted(), list[str]()

    def place(reader: Any, key: str) -> str:
        whole = reader.at(key) if isinstance(reader, Section) else f"{reader._place}{key}"
        return str(whole).removeprefix(before)

    def opened(reader: Any, known: Any, required: Any) -> None:
        here = root.at(place(reader, "").removesuffix("."))
        here.required = list(required) if not here.read else [k for k in here.required if k in required]
        here.read = True
        for key in known:
            here.at(key)

    saved: list[tuple[type, str, Any]] = []

    def instead(kind: type, name: str, made: Callable[..., Any]) -> None:
        plain = getattr(kind, name)
        saved.append((kind, name, plain))
        setattr(kind, name, lambda self, *args, **named: made(self, plain, *args, **named))

    def section(
        self: Any, plain: Any, path: Any, at: str, value: Any, required: Any = (), optional: Any = ()
    ) -> None:
        plain(self, path, at, value, required, optional)
        opened(self, (*required, *optional), required)

    def options(
        self: Any, plain: Any, values: Any, known: Any, needed: Any = (), *place: str, **named: str
    ) -> None:
        known = tuple(known)
        plain(self, values, known, needed, *place, **named)
        opened(self, known, needed)

    def mapping(self: Any, plain: Any, key: str) -> Any:
        root.at(place(self, key)).named = True
        return plain(self, key)

    def asking(asked: Callable[..., Schema]) -> Callable[..., Any]:
        def ask(self: Any, plain: Any, key: str, *args: Any, **named: Any) -> Any:
            if asks:  # a question that another one asks
                return plain(self, key, *args, **named)
            asks.append(key)
            try:
                found = plain(self, key, *args, **named)
            finally:
                asks.pop()
            root.at(place(self, key)).note(dict(asked(*args, **named)))
            return found

        return ask

    try:
        _put(Section, section, SECTION, instead, asking)
        instead(Section, "mapping", mapping)
        _put(OptionReader, options, OPTIONS, instead, asking)
        yield root
    finally:
        for kind, name, plain in reversed(saved):
            setattr(kind, name, plain)


def _put(kind: type, opening: Any, questions: Mapping[str, Any], instead: Any, asking: Any) -> None:
    """Put the watching questions in the place of a reader's own."""
    instead(kind, "__init__", opening)
    for name, asked in questions.items():
        instead(kind, name, asking(asked))


def mapping_in(schema: Schema) -> Schema:
    """Return the mapping among the kinds that a value may be."""
    return next((one for one in schema.get("anyOf", ()) if "properties" in one), schema)


def settings_schema(
    usual: Any, bounds: Mapping[str, tuple[float, float]], low: float | None = None, prefix: str = ""
) -> Schema:
    """Return the schema of a settings dataclass as `drivers.options.filled` reads it.

    ``bounds`` by key path; ``low`` is the lowest of a number that has none.
    """
    kinds = {bool: "boolean", int: "integer", float: "number", str: "string", dict: "object"}
    properties: Schema = {}
    for one in fields(usual):
        value, key = getattr(usual, one.name), prefix + one.name
        if is_dataclass(value):
            properties[one.name] = settings_schema(value, bounds, low, f"{key}.")
        elif type(value) in kinds:
            told: Schema = {"type": kinds[type(value)]}
            if type(value) in (int, float):
                told = number(*bounds.get(key, (low, None)), kind=told["type"])
            properties[one.name] = told if value in ("", {}) or value != value else {**told, "default": value}
    return {"type": "object", "additionalProperties": False, "properties": properties}
