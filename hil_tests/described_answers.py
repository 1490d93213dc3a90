"""Every answer that a daemon gives in a test is asked whether /openapi.json describes it."""

from __future__ import annotations

import gzip
import json
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from typing import Any

import jsonschema_rs
import pytest
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from mastctl import daemon as daemon_module
from mastctl.web.app import api, description


class Described:
    """What daemons say of themselves, and where an answer was another."""

    def __init__(self, document: Mapping[str, Any]) -> None:
        self._document = closed(document)
        self._validators: dict[str, Any] = {}
        self._paths = [
            (re.compile(re.sub(r"\\\{[^}]*\\\}", "[^/]+", re.escape(path))), path, methods)
            for path, methods in self._document["paths"].items()
        ]

    def check(self, scope: Scope, status: int, kind: str, body: bytes) -> Iterator[str]:
        """Tell where an answer is not as described."""
        found = next(
            ((path, known) for form, path, known in self._paths if form.fullmatch(scope["path"])), None
        )
        method = scope["method"].lower()
        if found is None or method not in found[1]:
            return  # refused before the routes
        path, known = found
        where = f"{scope['method']} {path}: {status}"
        responses = known[method]["responses"]
        told = responses.get(str(status)) or responses.get(f"{status // 100}XX")
        if told is None:
            yield f"{where} is none of the described {', '.join(responses)}"
            return
        content = told.get("content", {})
        if kind not in content:
            yield f"{where} is {kind}, described are {', '.join(content)}"
        elif kind == "application/json":
            body = gzip.decompress(body) if body.startswith(b"\x1f\x8b") else body
            validator = self._validator(f"{method} {path} {status}", content[kind]["schema"])
            for error in validator.iter_errors(json.loads(body)):
                yield f"{where}, {'/'.join(map(str, error.instance_path))}: {error.message[:200]}"
        elif kind == "text/event-stream":
            event = self._validator(f"{path} event", content[kind]["x-event"])
            for line in body.decode().splitlines():
                if line.startswith("data:"):
                    for error in event.iter_errors(json.loads(line.removeprefix("data:"))):
                        yield f"{where}, event: {error.message[:200]}"

    def _validator(self, name: str, schema: Mapping[str, Any]) -> Any:
        if name not in self._validators:
            whole = {"$ref": schema["$ref"], "components": self._document["components"]}
            self._validators[name] = jsonschema_rs.Draft202012Validator(whole)
        return self._validators[name]


def closed(document: Mapping[str, Any]) -> Any:
    """The document, whose objects have no keys but those that are described."""
    if isinstance(document, dict):
        told = {key: closed(value) for key, value in document.items()}
        if told.get("type") == "object" and "properties" in told:
            told.setdefault("additionalProperties", False)
        return told
    return [closed(one) for one in document] if isinstance(document, list) else document


@cache
def described() -> Described:
    """What the daemons of this process say of themselves; they have it in common."""
    return Described(json.loads(description(api())))


@contextmanager
def answers_checked() -> Iterator[list[str]]:
    """Have every daemon of this process checked; yields what was not as described."""
    complaints: list[str] = []
    plain: Callable[..., ASGIApp] = daemon_module.create_app  # type: ignore[attr-defined]

    def create_app(parts: Any) -> ASGIApp:
        app, known = plain(parts), described()

        async def watched(scope: Scope, receive: Receive, send: Send) -> None:
            status, kind, body = 0, "", bytearray()

            async def seen(message: Message) -> None:
                nonlocal status, kind, body
                await send(message)
                if message["type"] == "http.response.start":
                    status = message["status"]
                    told = dict(message["headers"]).get(b"content-type", b"")
                    kind = told.decode().partition(";")[0]
                elif message["type"] == "http.response.body" and not kind.startswith("image/"):
                    body += message.get("body", b"")

            try:
                await app(scope, receive, seen)
            finally:
                if status and scope["type"] == "http":
                    complaints.extend(known.check(scope, status, kind, bytes(body)))

        return watched

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(daemon_module, "create_app", create_app)
        yield complaints
