"""How /openapi.json describes the answers: by the types that the routes are annotated with, whose cost nobody
pays who only gets an answer.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, cast

from fastapi import FastAPI
from fastapi.responses import JSONResponse
from fastapi.routing import APIRoute
from pydantic import Field, TypeAdapter
from pydantic.json_schema import JsonSchemaMode
from typing_extensions import get_type_hints, is_typeddict

from mastctl.answers import Event, TrackTold
from mastctl.frame_facts import described_headers
from mastctl.http import PREFIX

EVENTS: Mapping[str, str] = {"GET /events": "Event", "GET /track/stream": TrackTold.__name__}
"""Server-sent events without an end: one line each, ``data:`` and the JSON of this kind."""
FILES: Mapping[str, tuple[str, ...]] = {
    "GET /snapshot/{camera}": ("image/png", "image/jpeg"),
    "GET /mast": ("application/yaml",),
    "GET /metrics": ("text/plain",),
    "GET /reports/{name}": ("text/html",),
    "GET /recordings/{name}/{file}": ("application/octet-stream",),
}
PICTURES = ("GET /snapshot/{camera}",)
_ONE_MAKES_IT = threading.Lock()
_REFERENCE = "#/components/schemas/{model}"


def description(app: FastAPI) -> bytes:
    """Return what /openapi.json tells of an app that has all its routes."""
    with _ONE_MAKES_IT:
        return _made(app)


def is_made() -> bool:
    """Return whether `description` only hands out what it has made before."""
    return _made.cache_info().currsize > 0


@cache
def _made(app: FastAPI) -> bytes:
    document = app.openapi()
    _describe(document, answers_of(app))
    return bytes(JSONResponse(document).body)


def answers_of(app: FastAPI) -> dict[str, type]:
    """Return the type of each route's answer, where that is a JSON object."""
    told: dict[str, type] = {}
    for route in app.routes:
        if isinstance(route, APIRoute) and route.include_in_schema:
            kind = get_type_hints(route.endpoint).get("return")
            if is_typeddict(kind):
                names = (f"{method} {route.path.removeprefix(PREFIX)}" for method in route.methods or ())
                told |= dict.fromkeys(names, cast(type, kind))
    return told


def schemas_of(kinds: Mapping[str, Any]) -> dict[str, Any]:
    """Return the JSON schema of each kind of answer and of its parts, by their names."""
    one: JsonSchemaMode = "serialization"
    inputs = [(name, one, TypeAdapter(kind)) for name, kind in sorted(kinds.items())]
    whole, parts = TypeAdapter.json_schemas(inputs, ref_template=_REFERENCE)
    named = {name: schema for (name, _), schema in whole.items() if "$ref" not in schema}
    return dict(parts["$defs"]) | named


def _describe(document: dict[str, Any], answers: Mapping[str, type]) -> None:
    """Put the answers, events and files where they are answered."""
    one = Field(discriminator="topic", title="Event", description="One event of ``/events``.")
    kinds = {kind.__name__: kind for kind in (*answers.values(), TrackTold)}
    document["components"]["schemas"].update(schemas_of({**kinds, "Event": Annotated[Event, one]}))
    _without_null(document)
    for route, success in _successes(document).items():
        if route in answers:
            kind = answers[route]
            success["description"] = (kind.__doc__ or kind.__name__).strip().splitlines()[0]
            success["content"] = {"application/json": {"schema": _reference(kind.__name__)}}
        elif route in EVENTS:
            stream = {"schema": {"type": "string"}, "x-endless": True, "x-event": _reference(EVENTS[route])}
            success["content"] = {"text/event-stream": stream}
        elif route in FILES:
            success["content"] = {kind: {"schema": _form(kind)} for kind in FILES[route]}
            if route in PICTURES:
                success["headers"] = described_headers()


def _form(kind: str) -> dict[str, str]:
    """What a file of a kind holds."""
    return {"type": "object"} if kind == "application/yaml" else {"type": "string", "format": "binary"}


def _without_null(document: Mapping[str, Any]) -> None:
    """Say of headers and queries that they are there or not: null is no word of an address."""
    for methods in document["paths"].values():
        for operation in methods.values():
            for parameter in operation.get("parameters", ()):
                schema = parameter["schema"]
                kinds = [one for one in schema.get("anyOf", ()) if one.get("type") != "null"]
                if len(kinds) == 1:
                    del schema["anyOf"]
                    schema.update(kinds[0])


def _successes(document: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The good answer of each route."""
    return {
        f"{method.upper()} {path.removeprefix(PREFIX)}": told
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
        for status, told in operation["responses"].items()
        if status.startswith("2")
    }


def _reference(name: str) -> dict[str, str]:
    return {"$ref": _REFERENCE.format(model=name)}
