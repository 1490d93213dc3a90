"""YAML read strictly: plain data, each refusal with its place; and written as people would.

PyYAML splits the text into events; this module builds the data from them: one document, no aliases, no tags,
no duplicate keys. Plain scalars follow the core schema of YAML 1.2, not PyYAML's YAML 1.1: ``on`` stays
text, ``1e-3`` is a number, ``1:30`` is not, dates are strings.
"""

from __future__ import annotations

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

MAX_BYTES = 4_000_000
MAX_DEPTH = 16

_INT = re.compile(r"[-+]?[0-9]+")
_FLOAT = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")
_CONSTANTS: dict[str, Any] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL"), None),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **{s + w: float(s + w[1:]) for s in ("", "+", "-") for w in (".inf", ".Inf", ".INF")},
    **dict.fromkeys((".nan", ".NaN", ".NAN"), float("nan")),
}


def parse_mapping(data: bytes, path: str | Path) -> dict[str, Any]:
    """Return the one mapping that UTF-8 bytes hold: str keys; dict, list, str, int, float, bool, None inside.

    Raises BadFile for everything else; the place is the line or the key.
    """
    if len(data) > MAX_BYTES:
        raise BadFile(path, "", f"is larger than {MAX_BYTES} bytes, the most that is read")
    text = text_of(data, path)
    try:
        document = _Builder(
            yaml.parse(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)), path
        ).document()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or getattr(error, "reason", None) or "it cannot be parsed"
        raise BadFile(path, f"line {mark.line + 1}" if mark else "", f"is not YAML: {problem}") from None
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
            return "a mapping" if value else "an empty mapping"
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
                raise BadFile(self.path, _line(event), "a list or mapping where a key is expected")
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
    if text in _CONSTANTS:
        return _CONSTANTS[text]
    if _INT.fullmatch(text):
        if len(text) > 400:
            raise BadFile(path, _line(event), f"a number of {len(text)} digits")
        return int(text)
    return float(text) if _FLOAT.fullmatch(text) else text


def _line(event: Any) -> str:
    return f"line {event.start_mark.line + 1}"


class _Dumper(yaml.SafeDumper):
    """Quotes all text that either YAML 1.1 or 1.2 would read as something else."""

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
    """Return plain data (else TypeError) as YAML: keys in their order, vectors on one line, floats in
    shortest form.

    Text that YAML 1.1 reads as something else (``on``) is quoted, so every YAML reader agrees.
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
    """Return the value as dict, list, str, int, float, bool, None; arrays become lists. Raises TypeError."""
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


def nearest(name: str, known: Sequence[str]) -> str:
    """Return the end of a refusal: the nearest known name, or all of them."""
    near = get_close_matches(name, known, n=1, cutoff=0.5)
    return f"the nearest known is '{near[0]}'" if near else f"known are {', '.join(known)}"
