"""YAML read strictly: plain data, every key known, each refusal with its place; and written as people would.

PyYAML splits the text into events; this module builds the data from them: one document, no aliases, no tags,
no duplicate keys. Plain scalars follow the core schema of YAML 1.2, not PyYAML's YAML 1.1: ``on`` stays a
word, ``1e-3`` is a number, ``1:30`` is not, dates are strings.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from calib.errors import BadFile
from calib.files import text_of
from calib.geometry.rigid import FloatArray

MAX_BYTES = 4_000_000
MAX_DEPTH = 16
_MAX_DIGITS = 400

_INT = re.compile(r"[-+]?[0-9]+")
_FLOAT = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")
_WORDS: dict[str, Any] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL"), None),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **{s + w: float(s + w[1:]) for s in ("", "+", "-") for w in (".inf", ".Inf", ".INF")},
    **dict.fromkeys((".nan", ".NaN", ".NAN"), float("nan")),
}

_PARSER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def parse_mapping(data: bytes, path: str | Path) -> dict[str, Any]:
    """Return the one mapping that the bytes hold: str keys; dict, list, str, int, float, bool, None inside.

    Parameters
    ----------
    data
        The file's bytes, UTF-8 (a byte-order mark is allowed).
    path
        For messages only.

    Raises
    ------
    BadFile
        For everything else; the place is the line or the key.
    """
    if len(data) > MAX_BYTES:
        raise BadFile(path, "", f"is larger than {MAX_BYTES} bytes, the most that is read")
    text = text_of(data, path)
    try:
        document = _Builder(yaml.parse(text, Loader=_PARSER), path).document()
    except yaml.YAMLError as error:
        raise BadFile(path, _line_of(error), f"is not YAML: {_problem_of(error)}") from None
    if not isinstance(document, dict):
        raise BadFile(path, "", f"holds {kind_of(document)} where keys with values are expected")
    return document


def kind_of(value: Any) -> str:
    """Name the kind of a value for a message, with the value where it is short."""
    match value:
        case None:
            return "nothing"
        case bool():
            return str(value).lower()
        case dict():
            return "a mapping"
        case list() | tuple():
            return f"a list of {len(value)}"
        case str():
            return f"the text '{value[:40]}{'...' if len(value) > 40 else ''}'"
        case _:
            return str(value) if not isinstance(value, int) or abs(value) < 1e20 else "a huge integer"


@dataclass
class _Builder:
    """Builds the one document's data of PyYAML's events."""

    events: Iterator[Any]
    path: str | Path

    def document(self) -> Any:
        next(self.events)  # the stream begins
        if isinstance(next(self.events), yaml.StreamEndEvent):
            raise BadFile(self.path, "", "holds no keys, only blanks or comments")
        document = self._value(next(self.events), "", 0)
        next(self.events)  # the document ends
        if not isinstance(event := next(self.events), yaml.StreamEndEvent):
            raise BadFile(self.path, _line(event), "a second document begins; one is expected")
        return document

    def _value(self, event: Any, place: str, depth: int) -> Any:
        """What an event and those that belong to it stand for."""
        if isinstance(event, yaml.AliasEvent):
            reason = f"alias *{event.anchor}; write the value out, aliases are not read"
            raise BadFile(self.path, _line(event), reason)
        if event.tag not in (None, "!"):
            hint = " (of NumPy's arrays write array.tolist())" if "python/" in event.tag else ""
            reason = f"tag {event.tag}; plain values are expected, tags are not read{hint}"
            raise BadFile(self.path, _line(event), reason)
        if isinstance(event, yaml.ScalarEvent):
            return _scalar(event, self.path)
        if depth == MAX_DEPTH:
            raise BadFile(self.path, _line(event), f"is nested deeper than {MAX_DEPTH} levels")
        if isinstance(event, yaml.SequenceStartEvent):
            items: list[Any] = []
            while not isinstance(event := next(self.events), yaml.SequenceEndEvent):
                items.append(self._value(event, f"{place}[{len(items)}]", depth + 1))
            return items
        keys: dict[str, Any] = {}
        while not isinstance(event := next(self.events), yaml.MappingEndEvent):
            if isinstance(event, (yaml.SequenceStartEvent, yaml.MappingStartEvent)):
                raise BadFile(self.path, _line(event), "a list or mapping stands where a key is expected")
            self._value(event, place, depth)  # refuses an alias or a tag
            at = f"{place}.{event.value}" if place else event.value
            if event.value in keys:
                raise BadFile(self.path, at, f"the key is there twice, again on {_line(event)}")
            keys[event.value] = self._value(next(self.events), at, depth + 1)
        return keys


def _scalar(event: Any, path: str | Path) -> Any:
    """A scalar's value by the core schema."""
    text: str = event.value
    if not event.implicit[0]:
        return text
    if text in _WORDS:
        return _WORDS[text]
    if _INT.fullmatch(text):
        if len(text) > _MAX_DIGITS:
            raise BadFile(path, _line(event), f"a number of {len(text)} digits")
        return int(text)
    return float(text) if _FLOAT.fullmatch(text) else text


def _line(event: Any) -> str:
    return f"line {event.start_mark.line + 1}"


def _line_of(error: yaml.YAMLError) -> str:
    mark = getattr(error, "problem_mark", None)
    return f"line {mark.line + 1}" if mark is not None else ""


def _problem_of(error: yaml.YAMLError) -> str:
    return str(getattr(error, "problem", None) or getattr(error, "reason", None) or "it cannot be parsed")


class _Dumper(yaml.SafeDumper):
    """Quotes every word that either YAML 1.1 or 1.2 would read as something else."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _text(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    # PyYAML folds odd line breaks (U+0085) into blanks in any other style.
    style = None if text.isprintable() else '"'
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_Dumper.add_representer(str, _text)
_Dumper.add_implicit_resolver("tag:yaml.org,2002:int", re.compile(_INT.pattern + "$"), list("-+0123456789"))
_Dumper.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(_FLOAT.pattern + "$"), list("-+.0123456789")
)


def dump_mapping(data: Mapping[str, Any]) -> bytes:
    """Return plain data as YAML: keys in their order, vectors on one line, floats in shortest form.

    Words that YAML 1.1 reads as something else (``on``) are quoted, so every YAML reader agrees.

    Raises
    ------
    TypeError
        If the data holds something that is not plain (see ``plain``).
    """
    text = yaml.dump(
        plain(data),
        Dumper=_Dumper,
        default_flow_style=None,
        sort_keys=False,
        allow_unicode=True,
        width=float("inf"),
    )
    return bytes(text.encode("utf-8"))


def plain(value: Any) -> Any:
    """Return the value as dict, list, str, int, float, bool and None; arrays become lists.

    Raises
    ------
    TypeError
        For a kind of value that a file cannot hold.
    """
    if isinstance(value, Mapping):
        if not all(isinstance(key, str) for key in value):
            raise TypeError("a key that is not text")
        return {key: plain(inner) for key, inner in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(inner) for inner in value]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"a value of type {type(value).__name__}")


def nearest(word: str, known: Sequence[str]) -> str:
    """Return the end of a refusal: the nearest known word, or all of them."""
    near = get_close_matches(word, known, n=1, cutoff=0.5)
    return f"the nearest known is '{near[0]}'" if near else f"known are {', '.join(known)}"


class Section:
    """One mapping of a file, with known keys.

    Parameters
    ----------
    path, place
        The file, and the key path to this mapping ('' for the whole file).
    value
        The value in the file.
    required, optional
        The keys that must and may be there.

    Raises
    ------
    BadFile
        If it is no mapping, a key is unknown, or a required key is missing.
    """

    def __init__(
        self,
        path: str | Path,
        place: str,
        value: Any,
        required: Sequence[str] = (),
        optional: Sequence[str] = (),
    ) -> None:
        self.path = path
        self.place = place
        known = (*required, *optional)
        if not isinstance(value, dict):
            raise self.bad("", f"{kind_of(value)} where a mapping with {', '.join(known)} is expected")
        self.values: dict[str, Any] = value
        for key in value:
            if key not in known:
                raise self.bad(key, f"unknown key; {nearest(key, known)}")
        for key in required:
            if key not in value:
                raise self.bad(key, "the key is missing")

    def at(self, key: str) -> str:
        """Return the key path of a key in here."""
        return f"{self.place}.{key}" if self.place and key else self.place or key

    def bad(self, key: str, reason: str) -> BadFile:
        """Return the refusal of a key's value."""
        return BadFile(self.path, self.at(key), reason)

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def text(self, key: str) -> str:
        """Return a value that must be text, not empty, on one line."""
        value = self.values[key]
        if not isinstance(value, str):
            raise self.bad(key, f"{kind_of(value)} where text is expected")
        if not value.strip() or not value.isprintable():
            raise self.bad(key, f"{value[:40]!r} where text on one line is expected")
        return value

    def choice(self, key: str, choices: Sequence[str]) -> str:
        """Return a value that must be one of the given words."""
        value = self.values[key]
        if value not in choices or not isinstance(value, str):
            raise self.bad(key, f"{kind_of(value)} where one of {', '.join(choices)} is expected")
        return value

    def number(self, key: str, limit: float = 1e9) -> float:
        """Return a value that must be a finite number of at most ``limit`` in size."""
        return self._number(key, self.values[key], limit)

    def between(self, key: str, low: float, high: float, usual: float | None = None) -> float:
        """Return a value that must be a number from low to high; ``usual``, if any, where it is left out."""
        if usual is not None and key not in self:
            return usual
        value = self.number(key)
        if not low <= value <= high:
            raise self.bad(key, f"{value:g} where a number from {low:g} to {high:g} is expected")
        return value

    def positive(self, key: str, most: float) -> float:
        """Return a value that must be a number above 0, at most ``most``."""
        value = self.number(key, most)
        if value <= 0.0:
            raise self.bad(key, f"{value:g} where a number above 0 is expected")
        return value

    def ends(self, key: str, limit: float) -> tuple[float, float]:
        """Return a value that must be ``[lowest, highest]``, each at most ``limit`` rad in size."""
        value = self.values[key]
        if not isinstance(value, list) or len(value) != 2:
            raise self.bad(key, "[lowest, highest] in radians is expected")
        low, high = (
            self._number(f"{key}.{name}", end, limit)
            for name, end in zip(("lowest", "highest"), value, strict=True)
        )
        if low >= high:
            raise self.bad(key, f"[{low:g}, {high:g}] where the lowest must be below the highest")
        return low, high

    def integer(self, key: str, low: int, high: int) -> int:
        """Return a value that must be an integer from low to high."""
        return self._integer(key, self.values[key], low, high)

    def integers(self, key: str, count: int, low: int, high: int) -> tuple[int, ...]:
        """Return a value that must be a list of ``count`` integers from low to high."""
        return tuple(
            self._integer(f"{key}[{i}]", item, low, high)
            for i, item in enumerate(self._list(key, count, "integers"))
        )

    def vector(self, key: str, limit: float = 1e9, count: int = 3) -> FloatArray:
        """Return a value that must be a list of ``count`` finite numbers, as (count,)."""
        items = self._list(key, count, "numbers")
        return np.array([self._number(f"{key}[{i}]", item, limit) for i, item in enumerate(items)])

    def covariance(self, key: str, count: int, limit: float = 1e9) -> FloatArray:
        """Return a value that must be ``count`` lists of as many numbers, and a covariance."""
        rows = Section(self.path, self.place, {}, (), ())
        rows.values = {f"{key}[{i}]": row for i, row in enumerate(self._list(key, count, "rows"))}
        matrix = np.array([rows.vector(row, limit, count) for row in rows.values])
        if not np.allclose(matrix, matrix.T) or np.linalg.eigvalsh(matrix)[0] < 0.0:
            raise self.bad(key, "no covariance: it must be symmetric, with no variance below zero")
        return matrix

    def section(self, key: str, required: Sequence[str] = (), optional: Sequence[str] = ()) -> Section:
        """Return a value that must be a mapping with known keys."""
        return Section(self.path, self.at(key), self.values[key], required, optional)

    def mapping(self, key: str) -> Mapping[str, Any]:
        """Return a value that must be a mapping with any keys; {} if the key is not there."""
        value = self.values.get(key, {})
        if not isinstance(value, dict):
            raise self.bad(key, f"{kind_of(value)} where a mapping is expected")
        return value

    def free(self, key: str) -> Mapping[str, Any]:
        """Return a mapping of any content in which every number is finite; {} if the key is not there."""
        value = self.mapping(key)
        self._all_finite(key, value)
        return value

    def _all_finite(self, key: str, value: Any) -> None:
        if isinstance(value, dict):
            for inner_key, inner in value.items():
                self._all_finite(f"{key}.{inner_key}", inner)
        elif isinstance(value, list):
            for i, inner in enumerate(value):
                self._all_finite(f"{key}[{i}]", inner)
        elif isinstance(value, float) and not math.isfinite(value):
            raise self.bad(key, f"{value} where a finite number is expected")

    def _list(self, key: str, count: int, what: str) -> list[Any]:
        value = self.values[key]
        if not isinstance(value, list) or len(value) != count:
            raise self.bad(key, f"{kind_of(value)} where a list of {count} {what} is expected")
        return value

    def _number(self, key: str, value: Any, limit: float) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise self.bad(key, f"{kind_of(value)} where a number is expected")
        if not abs(value) <= limit:  # an integer may be larger than any float
            raise self.bad(key, f"{kind_of(value)} where a finite number up to {limit:g} is expected")
        return float(value)

    def _integer(self, key: str, value: Any, low: int, high: int) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise self.bad(key, f"{kind_of(value)} where an integer from {low} to {high} is expected")
        return value
