"""Records of files as pydantic models: read strictly, refused in one sentence, described by a JSON Schema.

A model states keys, types, bounds and descriptions once. `read_record` takes from the model's own schema what
would be right, so that the sentence of a refusal, the check and the schema cannot differ. A value of one key
against another is checked by validators that raise `problem`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    WithJsonSchema,
)
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import PydanticCustomError

from calib.errors import BadFile
from calib.files.yaml_text import kind_of, nearest, parse_mapping

DIALECT = "https://json-schema.org/draft/2020-12/schema"


class Record(BaseModel):
    """A mapping with known keys; nothing is converted."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, populate_by_name=True)


Kind = TypeVar("Kind", bound=BaseModel)


def problem(key: str, reason: str) -> PydanticCustomError:
    """Return what a validator raises for the value at a key path in its record; '' for the record itself."""
    return PydanticCustomError("problem", "{reason}", {"key": key, "reason": reason})


def _printable(text: str) -> str:
    if not text.isprintable():
        raise problem("", f"{text[:40]!r} where text on one line is expected")
    return text


def _moment(time: str) -> str:
    try:
        datetime.fromisoformat(time).astimezone(UTC)
    except (ValueError, OverflowError):
        raise problem("", f"{time!r} where a moment of ISO 8601 is expected") from None
    return time


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


ABSENT: Any = None
"""The value of a key that a file may leave out; the key itself takes no null."""
Text = Annotated[str, Field(pattern=r"\S"), AfterValidator(_printable)]
"""Text on one line, not empty."""
Moment = Annotated[Text, AfterValidator(_moment)]
Number = Annotated[float, Field(ge=-1e9, le=1e9)]
Pair = Annotated[list[Number], Field(min_length=2, max_length=2)]
Vector = Annotated[list[Number], Field(min_length=3, max_length=3)]


def _beside(value: Any, info: ValidationInfo) -> Any:
    """The path that a file names, from its own folder; a path that a program gives stays."""
    if info.context is None:
        return value
    if not isinstance(value, str) or not value.strip():
        raise problem("", f"{kind_of(value)} where a path is expected")
    return info.context.resolve() / _printable(value)


PathInFile = Annotated[Path, BeforeValidator(_beside), WithJsonSchema({"type": "string", "pattern": r"\S"})]
"""A path; a relative one in a file starts at that file's folder."""
Free = Annotated[dict[str, Any], AfterValidator(_finite)]
"""A mapping of any content in which every number is finite."""


class _Schema(GenerateJsonSchema):
    """Without generated titles, and with plain defaults alone."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False

    def dict_schema(self, schema: Any) -> JsonSchemaValue:
        """A name of another pattern is refused, not just free of bounds."""
        found = super().dict_schema(schema)
        for pattern, values in found.pop("patternProperties", {}).items():
            found |= {"propertyNames": {"pattern": pattern}, "additionalProperties": values}
        return found

    def default_schema(self, schema: Any) -> JsonSchemaValue:
        found, default = self.generate_inner(schema["schema"]), schema.get("default")
        return found | {"default": default} if isinstance(default, (int, float, str)) else found

    def tagged_union_schema(self, schema: Any) -> JsonSchemaValue:
        """One key's value names the other keys: an editor then speaks of these alone."""
        key, choices = schema["discriminator"], schema["choices"]
        cases = [when(key, tag, self.generate_inner(choice)) for tag, choice in choices.items()]
        return {
            "type": "object",
            "required": [key],
            "properties": {key: {"enum": [*choices]}},
            "allOf": cases,
        }


def when(key: str, value: object, then: dict[str, Any]) -> dict[str, Any]:
    """Return the part of a JSON Schema that holds where a key has a value."""
    return {"if": {"required": [key], "properties": {key: {"const": value}}}, "then": then}


def schema_of(kind: Any, title: str) -> dict[str, Any]:
    """Return the JSON Schema of a file of these records, or of a value, without references."""
    found = TypeAdapter(kind).json_schema(schema_generator=_Schema)
    whole: dict[str, Any] = _inlined(found, found.get("$defs", {}))
    return {"$schema": DIALECT, **whole, "title": title}


def _inlined(node: Any, definitions: Mapping[str, Any]) -> Any:
    """The schema with its references replaced; docstrings of Python classes are no descriptions of keys."""
    if isinstance(node, str):
        return " ".join(node.split())
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


def parse_record(kind: type[Kind], data: bytes, path: str | Path, schema: str) -> Kind:
    """Return the record of a YAML file, of another ``schema`` refused before any key. Raises BadFile."""
    document = parse_mapping(data, path)
    if "schema" not in document:
        raise BadFile(path, "schema", f"the key is missing; 'schema: {schema}' is expected")
    if document["schema"] != schema:
        raise BadFile(path, "schema", f"{kind_of(document['schema'])} where '{schema}' is expected")
    return read_record(kind, document, path)


def read_record(kind: type[Kind], document: object, path: str | Path, place: str = "") -> Kind:
    """Return the record that plain data hold; ``path`` and ``place`` are for messages.

    Raises BadFile with the place of the first mistake, its value and what would be right; see `_order`.
    """
    try:
        return kind.model_validate(document, context=Path(path).parent)
    except ValidationError as error:
        raise _refusal(error, schema_of(kind, ""), path, place) from None


def read_value(kind: Any, value: object, path: str | Path, place: str) -> Any:
    """Return one value of a file, of an annotated type that is no record. Raises BadFile as `read_record`."""
    try:
        return TypeAdapter(kind, config=ConfigDict(strict=True)).validate_python(value)
    except ValidationError as error:
        raise _refusal(error, schema_of(kind, ""), path, place) from None


def _refusal(error: ValidationError, schema: dict[str, Any], path: str | Path, place: str) -> BadFile:
    """The first mistake as a sentence."""
    (first_place, reason), *_ = mistakes_in(error.errors(include_url=False), schema, place)
    return BadFile(path, first_place, reason)


def mistakes_in(errors: Sequence[Any], schema: dict[str, Any], place: str = "") -> list[tuple[str, str]]:
    """Return the place and the reason of each of pydantic's errors, the first to be mended first.

    ``schema`` (`schema_of`) says what would be right; ``place`` is that of the whole value.
    """
    return [_mistake(one, schema, place) for one in sorted(errors, key=_order)]


def _mistake(mistake: Any, schema: dict[str, Any], place: str) -> tuple[str, str]:
    steps: list[int | str] = [step for step in mistake["loc"] if step != "[key]"]
    value = mistake["input"]
    if mistake["type"].startswith("union_tag"):
        key = mistake["ctx"]["discriminator"].strip("'")
        steps.append(key)
        value = value.get(key)
    expected, place_steps = _part(schema, steps)
    match mistake["type"]:
        case "problem":
            place_steps += [mistake["ctx"]["key"]] if mistake["ctx"]["key"] else []
            reason = mistake["ctx"]["reason"]
        case "value_error":
            reason = mistake["msg"].removeprefix("Value error, ")
        case "missing":
            reason = "the key is missing" if steps else "nothing where a mapping is expected"
        case "union_tag_not_found":
            reason = f"the key is missing; {', '.join(expected['enum'])} are known"
        case "extra_forbidden" | "unexpected_keyword_argument":
            known = tuple(_part(schema, steps[:-1])[0].get("properties", {}))
            reason = f"unknown key; {nearest(str(steps[-1]), known)}"
        case _:
            reason = f"{kind_of(value)} where {_expected(expected, value)} is expected"
    return _joined([place, *place_steps]), reason


def _order(mistake: Any) -> tuple[int, bool, bool]:
    """The outermost mistakes come first; of those unknown keys, then missing ones."""
    depth = sum(step != "[key]" for step in mistake["loc"])
    kind = mistake["type"]
    unknown = kind in ("extra_forbidden", "unexpected_keyword_argument")
    return depth, not unknown and kind != "missing", not unknown


def _joined(steps: Sequence[int | str]) -> str:
    """A key path: ``cameras.left.C[0]``."""
    path = ""
    for step in steps:
        path += f"[{step}]" if isinstance(step, int) else f".{step}" if path and step else str(step)
    return path


def _part(schema: dict[str, Any], steps: Sequence[int | str]) -> tuple[dict[str, Any], list[int | str]]:
    """The schema of a value inside, and the steps to it in the file: without the name of a kind of record."""
    place: list[int | str] = []
    for step in (*steps, None):
        schema = next((one for one in schema.get("anyOf", ()) if one.get("type") != "null"), schema)
        if step is None:
            break
        cases = [(one, *one["if"]["properties"].values()) for one in schema.get("allOf", ())]
        kinds = [one["then"] for one, value in cases if value["const"] == step]  # as `when` writes them
        if kinds and step not in schema["properties"]:
            schema = kinds[0]
            continue
        place.append(step)
        if isinstance(step, int):
            inner = schema.get("prefixItems", [])
            schema = inner[step] if step < len(inner) else schema.get("items", {})
        else:
            schema = schema.get("properties", {}).get(step) or schema.get("additionalProperties") or {}
    return schema, place


def _expected(schema: dict[str, Any], value: object) -> str:
    """What would be right, as the part of a sentence."""
    if "const" in schema:
        return f"'{schema['const']}'"
    if "enum" in schema:
        return f"one of {', '.join(map(str, schema['enum']))}"
    match schema.get("type"):
        case "integer":
            return f"an integer from {schema['minimum']} to {schema['maximum']}"
        case "boolean":
            return "true or false"
        case "number":
            return _number_expected(schema, value)
        case "array":
            return _list_expected(schema)
        case "object":
            if "minProperties" in schema and value == {}:
                return "at least one entry"
            keys = ", ".join(schema.get("properties", ()))
            return f"a mapping with {keys}" if keys else "a mapping"
    if isinstance(value, str) and len(value) > schema.get("maxLength", len(value)):
        return f"text of up to {schema['maxLength']} characters"
    return "text on one line" if isinstance(value, str) else "text"


def _number_expected(schema: dict[str, Any], value: object) -> str:
    low, high = schema.get("minimum"), schema.get("maximum", math.inf)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return "a number"
    if "exclusiveMinimum" in schema and value <= schema["exclusiveMinimum"]:
        return f"a number above {schema['exclusiveMinimum']:g}"
    if low is None or (low == -high and (high > 1e4 or not abs(value) < math.inf)):
        return f"a finite number up to {high:g}"
    return f"a number from {low:g} to {high:g}"


def _list_expected(schema: dict[str, Any]) -> str:
    inner, least, most = schema.get("items", {}), schema.get("minItems"), schema.get("maxItems")
    kinds = {"integer": "integers", "number": "numbers", "array": "lists", "string": "names"}
    what = kinds.get(inner.get("type"), "values")
    if inner.get("type") == "array":
        size = inner.get("maxItems")
        what = "pairs of numbers" if size == 2 else f"lists of {size} numbers"
    if least is not None and least == most:
        return f"a list of {least} {what}"
    return f"a list of up to {most} {what}" if most is not None else f"a list of {what}"
