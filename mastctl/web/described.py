"""/openapi.json: FastAPI's description of the routes, with the types that they are annotated with as answers.

The types are looked at when the description is requested; an answer is sent as it is made.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any

from fastapi import FastAPI
from fastapi.responses import JSONResponse
from fastapi.routing import APIRoute
from fastapi.utils import create_model_field
from pydantic import Field, TypeAdapter
from typing_extensions import get_type_hints, is_typeddict

from mastctl.answers import Event, TrackTold

_REFERENCE = "#/components/schemas/{model}"
_ONE_MAKES_IT = threading.Lock()


def stream_of(kind: str) -> dict[int | str, dict[str, Any]]:
    """Return the responses of a route of server-sent events: one line each, ``data:`` and JSON of a kind."""
    event = {"$ref": _REFERENCE.format(model=kind)}
    stream = {"schema": {"type": "string"}, "x-endless": True, "x-event": event}
    return {200: {"content": {"text/event-stream": stream}}}


def file_of(*kinds: str, **others: Any) -> dict[int | str, dict[str, Any]]:
    """Return the responses of a route that answers a file, of one of these media types."""
    form = {"type": "string", "format": "binary"}
    return {200: {"content": {kind: {"schema": form} for kind in kinds}, **others}}


def description(app: FastAPI) -> bytes:
    """Return /openapi.json of an app that has all its routes."""
    with _ONE_MAKES_IT:
        return _made(app)


def is_made() -> bool:
    """Return whether `description` only hands out what it has made before."""
    return _made.cache_info().currsize > 0


@cache
def _made(app: FastAPI) -> bytes:
    for route in app.routes:
        if isinstance(route, APIRoute) and route.include_in_schema:
            kind: Any = get_type_hints(route.endpoint).get("return")
            if is_typeddict(kind):
                route.response_field = create_model_field(kind.__name__, kind, mode="serialization")
                route.response_description = (kind.__doc__ or kind.__name__).strip().splitlines()[0]
    document = app.openapi()
    one = Field(discriminator="topic", title="Event", description="One event of ``/events``.")
    streamed: dict[str, Any] = {"Event": Annotated[Event, one], "TrackTold": TrackTold}
    for name, streams in streamed.items():
        schema = TypeAdapter(streams).json_schema(mode="serialization", ref_template=_REFERENCE)
        document["components"]["schemas"] |= schema.pop("$defs", {}) | {name: schema}
    _without_null(document)
    return bytes(JSONResponse(document).body)


def _without_null(document: Mapping[str, Any]) -> None:
    """Say of headers and queries that they are there or not: an address has no null."""
    for methods in document["paths"].values():
        for operation in methods.values():
            for parameter in operation.get("parameters", ()):
                schema = parameter["schema"]
                kinds = [one for one in schema.get("anyOf", ()) if one.get("type") != "null"]
                if len(kinds) == 1:
                    del schema["anyOf"]
                    schema.update(kinds[0])
