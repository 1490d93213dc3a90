"""Texts that do not change while a daemon runs: compressed once, and kept by the browser that has them."""

from __future__ import annotations

import gzip
import hashlib
from collections.abc import Mapping
from functools import cache

from fastapi import Response

ASK_AGAIN = "no-cache"
"""A browser keeps it, and asks each time whether it is still so."""
FOR_GOOD = "public, max-age=31536000, immutable"
"""What stands at this address will never be another text."""


def text_answer(asked: Mapping[str, str], data: bytes, kind: str, keep: str = ASK_AGAIN) -> Response:
    """Return a text, compressed where the client takes that; 304 without it where the client has it.

    Parameters
    ----------
    asked
        The request's headers, names in lower case.
    data, kind
        The text, and its media type.
    keep
        What the browser may do with it, as Cache-Control.
    """
    tag = f'W/"{digest(data)}"'  # the same for both forms
    headers = {"Cache-Control": keep, "ETag": tag, "Vary": "Accept-Encoding"}
    if tag in asked.get("if-none-match", ""):
        return Response(status_code=304, headers=headers)
    if "gzip" in asked.get("accept-encoding", ""):
        return Response(_packed(data), media_type=kind, headers=headers | {"Content-Encoding": "gzip"})
    return Response(data, media_type=kind, headers=headers)


@cache
def digest(data: bytes) -> str:
    """Return 16 hexadecimal digits that tell a text from others."""
    return hashlib.sha256(data).hexdigest()[:16]


@cache
def _packed(data: bytes) -> bytes:
    return gzip.compress(data, mtime=0)
