"""Records of files as pydantic models: read strictly, refused in one sentence, described by a JSON Schema.

A model states keys, types, bounds and descriptions once. `read_record` takes from the model's own schema what
would be right, so that the sentence of a refusal, the check and the schema cannot differ. A value of one key
against another is checked by validators that raise `problem`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import PydanticCustomError

from calib.errors import BadFile
from calib.files.yaml_text import kind_of, nearest

DIALECT = "https://json-schema.org/draft/2020-12/schema"


class Record(BaseModel):
    """A mapping with known keys; nothing is converted."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, populate_by_name=True)


Kind = TypeVar("Kind", bound=Record)


def problem(key: str, reason: str) -> PydanticCustomError:
    """Return what a validator raises for the value at a key path in its record; '' for the record itself."""
    return PydanticCustomError("problem", "{reason}", {"key": key, "reason": reason})


def _printable(text: str) -> str:
    if not text.isprintable():
        raise problem("", f"{text[:40]!r} where text on one line is expected")
    return text


def _finite(content: dict[str, Any]) -> dict[str, Any]:
    """Refuse a number anywhere inside that is not finite."""

    def check(value: Any, place: str) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                check(inner, f"{place}.{key}" if place else key)
        elif isinstance(value, list):
            for at, inner in enumerate(value):
                check(inner, f"{place}[{at}]")
        elif isinstance(value, float) and not math.isfinite(value):
            raise problem(place, f"{value} where a finite number is expected")

    check(content, "")
    return content


Text = Annotated[str, Field(pattern=r"\S"), AfterValidator(_printable)]
"""Text on one line, not empty."""
Number = Annotated[float, Field(ge=-1e9, le=1e9)]
Vector = Annotated[list[Number], Field(min_length=3, max_length=3)]
Free = Annotated[dict[str, Any], AfterValidator(_finite)]
"""A mapping of any content in which every number is finite."""


class _Schema(GenerateJsonSchema):
    """Without titles and defaults that nobody wrote."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False

    def dict_schema(self, schema: Any) -> JsonSchemaValue:
        """A name of another pattern is refused, not just free of bounds."""
        found = super().dict_schema(schema)
        for pattern, values in found.pop("patternProperties", {}).items():
            found |= {"propertyNames": {"pattern": pattern}, "additionalProperties": values}
        return found

    def default_schema(self, schema: Any) -> JsonSchemaValue:
        return self.generate_inner(schema["schema"])


def schema_of(kind: type[Record], title: str) -> dict[str, Any]:
    """Return the JSON Schema of a file of these records, without references."""
    found: dict[str, Any] = kind.model_json_schema(schema_generator=_Schema)
    whole: dict[str, Any] = _inlined(found, found.get("$defs", {}))
    return {"$schema": DIALECT, **whole, "title": title}


def _inlined(node: Any, definitions: Mapping[str, Any]) -> Any:
    """The schema with its references replaced; docstrings of Python classes are no descriptions of keys."""
    if isinstance(node, list):
        return [_inlined(one, definitions) for one in node]
    if not isinstance(node, dict):
        return node
    if "$ref" in node:
        rest = {key: value for key, value in node.items() if key != "$ref"}
        return _inlined(definitions[node["$ref"].rsplit("/", 1)[1]], definitions) | rest
    is_record = node.get("type") == "object" and "properties" in node
    dropped = ("$defs", "title", "description") if is_record else ("$defs",)
    return {key: _inlined(one, definitions) for key, one in node.items() if key not in dropped}


def read_record(kind: type[Kind], document: object, path: str | Path, place: str = "") -> Kind:
    """Return the record that plain data hold; ``path`` and ``place`` are for messages.

    Raises
    ------
    BadFile
        With the place of the first mistake, its value and what would be right; unknown keys come first.
    """
    try:
        return kind.model_validate(document)
    except ValidationError as error:
        mistakes = error.errors(include_url=False)
    mistake = min(mistakes, key=lambda one: one["type"] != "extra_forbidden")
    steps: list[int | str] = [step for step in mistake["loc"] if step != "[key]"]
    inner, reason = "", ""
    around = _part(schema_of(kind, ""), steps[:-1])
    match mistake["type"]:
        case "problem":
            inner, reason = mistake["ctx"]["key"], mistake["ctx"]["reason"]
        case "missing":
            reason = "the key is missing"
        case "extra_forbidden":
            reason = f"unknown key; {nearest(str(steps[-1]), tuple(around.get('properties', {})))}"
        case _:
            expected = _expected(_part(schema_of(kind, ""), steps), mistake["input"])
            reason = f"{kind_of(mistake['input'])} where {expected} is expected"
    raise BadFile(path, _joined([place, *steps, *([inner] if inner else [])]), reason)


def _joined(steps: Sequence[int | str]) -> str:
    """A key path: ``cameras.left.C[0]``."""
    path = ""
    for step in steps:
        path += f"[{step}]" if isinstance(step, int) else f".{step}" if path and step else str(step)
    return path


def _part(schema: dict[str, Any], steps: Sequence[int | str]) -> dict[str, Any]:
    """The schema of a value inside."""
    for step in steps:
        if isinstance(step, int):
            inner = schema.get("prefixItems", [])
            schema = inner[step] if step < len(inner) else schema.get("items", {})
        else:
            schema = schema.get("properties", {}).get(step) or schema.get("additionalProperties") or {}
    return schema


def _expected(schema: dict[str, Any], value: object) -> str:
    """What would be right, as the part of a sentence."""
    if "const" in schema:
        return f"'{schema['const']}'"
    if "enum" in schema:
        return f"one of {', '.join(map(str, schema['enum']))}"
    low, high = schema.get("minimum"), schema.get("maximum")
    match schema.get("type"):
        case "integer":
            return f"an integer from {low} to {high}"
        case "number":
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                return "a number"
            if low is not None and low == -(high or 0.0):
                return f"a finite number up to {high:g}"
            return f"a number from {low:g} to {high:g}"
        case "array":
            return _list_expected(schema)
        case "object":
            keys = ", ".join(schema.get("properties", ()))
            return f"a mapping with {keys}" if keys else "a mapping"
    return "text on one line" if isinstance(value, str) else "text"


def _list_expected(schema: dict[str, Any]) -> str:
    inner, least, most = schema.get("items", {}), schema.get("minItems"), schema.get("maxItems")
    kinds = {"integer": "integers", "number": "numbers", "array": "lists", "string": "texts"}
    what = kinds.get(inner.get("type"), "values")
    if inner.get("type") == "array":
        size = inner.get("maxItems")
        what = "pairs of numbers" if size == 2 else f"lists of {size} numbers"
    if least is not None and least == most:
        return f"a list of {least} {what}"
    return f"a list of up to {most} {what}" if most is not None else f"a list of {what}"
