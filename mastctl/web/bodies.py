"""Bodies of requests: bounded, and JSON as the standard has it."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping
from typing import Any, NoReturn

from starlette.types import Message, Receive

from mastctl.web.answer import GuardError

LARGEST_BODY_BYTES = 65536


async def whole_body(receive: Receive, headers: Mapping[str, str]) -> bytes:
    """Return the whole body, which may not be large. Raises GuardError."""
    told = headers.get("content-length", "0")
    if told.isdecimal() and int(told[:20]) > LARGEST_BODY_BYTES:
        _too_large()
    parts: list[bytes] = []
    size = 0
    while True:
        message = await receive()
        if message["type"] == "http.disconnect":
            raise GuardError(400, "disconnected", "the client left before its request had come whole")
        part = message.get("body", b"")
        size += len(part)
        if size > LARGEST_BODY_BYTES:
            _too_large()
        parts.append(part)
        if not message.get("more_body", False):
            return b"".join(parts)


def _too_large() -> NoReturn:
    raise GuardError(413, "too_large", f"the body is larger than {LARGEST_BODY_BYTES} bytes")


def read_json(body: bytes, headers: Mapping[str, str]) -> Any:
    """Return what a body holds: JSON with finite numbers and each key once; None for nothing.

    Raises
    ------
    GuardError
        ``not_json``; ``bad_request`` for a number that is JSON and larger than any float.
    """
    if not body.strip():
        return None
    kind = headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":
        raise GuardError(415, "not_json", f"Content-Type is '{kind[:60]}' where application/json is expected")
    try:
        return json.loads(
            body, parse_constant=_no_constant, parse_float=_finite, object_pairs_hook=_no_duplicates
        )
    except RecursionError:
        raise GuardError(400, "not_json", "the body is nested too deeply") from None
    except ValueError as error:
        raise GuardError(400, "not_json", f"the body is not JSON: {' '.join(str(error).split())}") from None


def _no_constant(word: str) -> NoReturn:
    raise ValueError(f"{word} where a finite number is expected")


def _finite(word: str) -> float:
    number = float(word)
    if math.isinf(number):
        words = f"the body holds the number {word[:40]} where at most {sys.float_info.max:.1e} is possible"
        raise GuardError(422, "bad_request", words)
    return number


def _no_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"the key '{key[:60]}' is there twice")
        found[key] = value
    return found


def once(body: bytes, receive: Receive) -> Receive:
    """Give the body that was read already, then whatever comes."""
    given = False

    async def again() -> Message:
        nonlocal given
        if not given:
            given = True
            return {"type": "http.request", "body": body, "more_body": False}
        return await receive()

    return again
