"""What is wrong with a body or a query, as a plain sentence: place, value, what is expected."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, get_args

from calib.files.yaml_text import nearest


def sentence(problem: Mapping[str, Any], model: object) -> str:
    """Return one validation problem of pydantic as a plain sentence: place, value, what is expected.

    Parameters
    ----------
    problem
        One entry of pydantic's list of errors.
    model
        What the body or the query is read by, for the keys it knows and the words for what is expected; of a
        path, the parameter's own facts. None if not known.
    """
    where = tuple(str(step) for step in problem["loc"])
    place = _place(where)
    kind = problem["type"]
    words = str(problem["msg"])
    if kind == "value_error":
        return words.removeprefix("Value error, ")
    if kind == "missing":
        return f"{place} is missing" if len(where) > 1 else "the body is missing; a JSON object is expected"
    if kind in ("extra_forbidden", "unexpected_keyword_argument"):
        known = _keys(model, where[1:-1])
        return f"{place}: unknown key; {nearest(where[-1], known)}" if known else f"{place}: unknown key"
    value = _short(problem.get("input"))
    if kind == "string_pattern_mismatch" and (expected := _described(model, where[1:])):
        return f"{place}: {value} where {expected} is expected"
    if kind in ("too_short", "too_long"):
        size = 4 if where[-1] == "quaternion" else 3
        return f"{place}: {value} where a list of {size} numbers is expected"
    if kind in ("model_attributes_type", "model_type", "dict_type", "dataclass_type"):
        return f"{place}: {value} where an object with keys is expected"
    for start in ("Input should be ", "String should have "):
        if words.startswith(start):
            expected = words.removeprefix(start).partition(", unable to")[0]
            return f"{place}: {value} where {expected} is expected"
    return f"{place}: {value}: {words}"


def _keys(model: object, place: Sequence[str]) -> list[str]:
    """The keys that a model or dataclass knows, or at a place inside it what stands there."""
    for candidate in (model, *get_args(model)):
        fields = getattr(candidate, "model_fields", None) or getattr(candidate, "__pydantic_fields__", None)
        if fields is None:
            continue
        if not place:
            return list(fields)
        if place[0] in fields:
            return _keys(fields[place[0]].annotation, place[1:])
    return []


def _described(model: object, place: Sequence[str]) -> str | None:
    """What is expected at a place, in the words of the model, or of a path's parameter itself."""
    for candidate in (model, *get_args(model)):
        fields = getattr(candidate, "model_fields", None) or {}
        if place and place[0] in fields:
            return fields[place[0]].description or _described(fields[place[0]].annotation, place[1:])
    return getattr(model, "description", None)


def _place(where: tuple[str, ...]) -> str:
    """``("body", "position_m", "0")`` as ``position_m[0]``."""
    place = ""
    for step in where[1:]:
        place += f"[{step}]" if step.isdecimal() else f".{step}" if place else step
    return place[:120] or f"the {where[0]}"


def _short(value: Any) -> str:
    """A value as JSON, cut short."""
    try:
        text = json.dumps(value)
    except (TypeError, ValueError):
        text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
