"""That /openapi.json describes what was answered."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from mastctl.client.connection import PREFIX
from mastctl.conform.checks import PromiseBroken, Suite, expect
from mastctl.conform.daemon import Daemon, field
from mastctl.conform.wire import Answer

DESCRIBED: Suite[Daemon] = Suite()

BEFORE_THE_ROUTES = {"not_found", "method_not_allowed"}


@DESCRIBED.check("openapi.paths", "/openapi.json describes the paths that the contract names")
def _paths(daemon: Daemon) -> str:
    paths = field(_description(daemon), "paths")
    for method, path in (
        ("get", "/status"), ("post", "/point"), ("get", "/operations"), ("get", "/operations/{operation_id}"),
        ("post", "/stop"), ("post", "/estop"), ("post", "/reset"), ("get", "/snapshot/{camera}"),
        ("get", "/mast"),
    ):  # fmt: skip
        known = [told for told in paths if _same(told, PREFIX + path)]
        expect(known and method in paths[known[0]], f"{method.upper()} {PREFIX}{path} is not described")
    return f"{len(paths)} paths"


@DESCRIBED.check("openapi.answers", "every answer so far is described: path, method, status, kind and form")
def _answers(daemon: Daemon) -> str:
    description = _description(daemon)
    asked = 0
    for answer in daemon.wire.answers:
        if answer.path.startswith(PREFIX) and answer.refusal[0] not in BEFORE_THE_ROUTES:
            _check_answer(answer, description)
            asked += 1
    return f"{asked} answers"


def _description(daemon: Daemon) -> Mapping[str, Any]:
    """The document."""
    document = daemon.wire.send("GET", "/openapi.json").document()
    version = field(document, "openapi")
    expect(isinstance(version, str) and version.startswith("3."), f"openapi is {version!r}, not 3.x")
    return document


def _check_answer(answer: Answer, description: Mapping[str, Any]) -> None:
    """Pass an answer as it is described. Raises PromiseBroken."""
    where = f"{answer.asked}: {answer.status}"
    paths = [told for path, told in description["paths"].items() if _matches(path, answer.path)]
    expect(paths, f"{answer.asked} answered {answer.status}, the path is not described")
    method = paths[0].get(answer.method.lower())
    expect(method is not None, f"{answer.asked} answered {answer.status}, the method is not described")
    responses = field(method, "responses")
    status = str(answer.status)
    told = responses.get(status) or responses.get(f"{status[0]}XX") or responses.get("default")
    expect(told is not None, f"{where} is none of the described {', '.join(responses)}")
    content = told.get("content", {})
    if content:
        expect(
            answer.media_type in content,
            f"{where} is {answer.media_type}, described are {', '.join(content)}",
        )
    schema = content.get("application/json", {}).get("schema")
    if schema is not None and answer.media_type == "application/json":
        _check_form(answer.json(), schema, description, where)


TYPES: Mapping[str, type | tuple[type, ...]] = {
    "object": dict, "array": list, "string": str, "boolean": bool, "null": type(None),
    "integer": int, "number": (int, float),
}  # fmt: skip


def _check_form(value: Any, schema: Any, description: Mapping[str, Any], where: str) -> None:
    """Pass a value of the described type with its required keys, and these in turn.

    Of JSON Schema only what says type and keys is read: ``$ref``, ``anyOf``, ``type``, ``required``,
    ``properties``, ``items``, ``enum``; bounds of numbers are not.
    """
    if not isinstance(schema, Mapping):
        return None
    if "$ref" in schema:
        here: Any = description
        for key in str(schema["$ref"]).removeprefix("#/").split("/"):
            here = field(here, key)
        return _check_form(value, here, description, where)
    if "anyOf" in schema:
        reasons = []
        for one in schema["anyOf"]:
            try:
                return _check_form(value, one, description, where)
            except PromiseBroken as reason:
                reasons.append(str(reason))
        raise PromiseBroken(reasons[0])
    kind = schema.get("type")
    if isinstance(kind, str) and kind in TYPES:
        right = isinstance(value, TYPES[kind]) and (kind == "boolean" or not isinstance(value, bool))
        expect(right, f"{where}: {str(value)[:60]!r} where {kind} is described")
    if "enum" in schema:
        expect(value in schema["enum"], f"{where}: {value!r} is none of the described values")
    if isinstance(value, dict):
        for key in schema.get("required", ()):
            expect(key in value, f"{where}: the described key {key} is missing")
        for key, below in schema.get("properties", {}).items():
            if key in value:
                _check_form(value[key], below, description, f"{where}, {key}")
    elif isinstance(value, list):
        for one in value:
            _check_form(one, schema.get("items"), description, where)
    return None


def _matches(template: str, path: str) -> bool:
    """Whether a described path stands for one that was asked."""
    pattern = "".join(
        "[^/]+" if part.startswith("{") else re.escape(part) for part in re.split(r"(\{[^}]*\})", template)
    )
    return re.fullmatch(pattern, path) is not None


def _same(template: str, other: str) -> bool:
    """Whether two described paths are one, whatever their parameters are called."""
    return re.sub(r"\{[^}]*\}", "{}", template) == re.sub(r"\{[^}]*\}", "{}", other)
