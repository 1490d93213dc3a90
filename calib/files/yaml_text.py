"""YAML as plain data: one document, no aliases, no tags, no duplicate keys, numbers as people write them.

PyYAML splits the text into events; this module builds the data from them. Plain scalars follow the core
schema of YAML 1.2, not PyYAML's YAML 1.1: ``on`` stays a word, ``1e-3`` is a number, ``1:30`` is not, dates
are strings.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from calib.errors import BadFile

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
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise BadFile(path, f"line {line}", f"byte 0x{data[error.start]:02x} is not UTF-8 text") from None
    try:
        document = _build(yaml.parse(text, Loader=_PARSER), path)
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


class _Node:
    """A mapping or list under construction: ``key`` is what the next value belongs to."""

    def __init__(self, holder: dict[str, Any] | list[Any], place: str) -> None:
        self.holder = holder
        self.place = place
        self.key: str | None = None

    def inner_place(self) -> str:
        step = f"[{len(self.holder)}]" if isinstance(self.holder, list) else str(self.key or "")
        return f"{self.place}.{step}" if self.place and not step.startswith("[") else self.place + step


def _build(events: Iterator[Any], path: str | Path) -> Any:
    """Build the one document's data; a stack instead of recursion, so depth is counted, not suffered."""
    document: Any = None
    documents = 0
    stack: list[_Node] = []
    for event in events:
        line = f"line {event.start_mark.line + 1}"
        if isinstance(event, yaml.DocumentStartEvent):
            documents += 1
            if documents > 1:
                raise BadFile(path, line, "a second document begins; one is expected")
        elif isinstance(event, yaml.AliasEvent):
            raise BadFile(path, line, f"alias *{event.anchor}; write the value out, aliases are not read")
        elif isinstance(event, (yaml.MappingEndEvent, yaml.SequenceEndEvent)):
            stack.pop()
        elif isinstance(event, (yaml.ScalarEvent, yaml.MappingStartEvent, yaml.SequenceStartEvent)):
            if event.tag not in (None, "!"):
                raise BadFile(path, line, f"tag {event.tag}; plain values are expected, tags are not read")
            top = stack[-1] if stack else None
            if top is not None and isinstance(top.holder, dict) and top.key is None:
                top.key = _key(event, top, path, line)
                continue
            value = _value(event, path, line)
            place = top.inner_place() if top is not None else ""
            if top is None:
                document = value
            elif isinstance(top.holder, dict):
                top.holder[str(top.key)] = value
                top.key = None
            else:
                top.holder.append(value)
            if isinstance(value, (dict, list)):
                if len(stack) == MAX_DEPTH:
                    raise BadFile(path, line, f"is nested deeper than {MAX_DEPTH} levels")
                stack.append(_Node(value, place))
    if documents == 0:
        raise BadFile(path, "", "holds no keys, only blanks or comments")
    return document


def _key(event: Any, node: _Node, path: str | Path, line: str) -> str:
    """Return a mapping's key, which must be a word that is not there yet."""
    if not isinstance(event, yaml.ScalarEvent):
        raise BadFile(path, line, "a list or mapping stands where a key is expected")
    key: str = event.value
    assert isinstance(node.holder, dict)
    if key in node.holder:
        place = f"{node.place}.{key}" if node.place else key
        raise BadFile(path, place, f"the key is there twice, again on {line}")
    return key


def _value(event: Any, path: str | Path, line: str) -> Any:
    """Return what an event stands for: an empty holder, or the scalar's value."""
    if isinstance(event, yaml.MappingStartEvent):
        return {}
    if isinstance(event, yaml.SequenceStartEvent):
        return []
    text: str = event.value
    if not event.implicit[0]:
        return text
    if text in _WORDS:
        return _WORDS[text]
    if _INT.fullmatch(text):
        if len(text) > _MAX_DIGITS:
            raise BadFile(path, line, f"a number of {len(text)} digits")
        return int(text)
    return float(text) if _FLOAT.fullmatch(text) else text


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
