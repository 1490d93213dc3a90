"""Texts compressed where the client takes that; those that never change are kept by the browser too."""

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
QUICKLY = 1
PACKED = {"Content-Encoding": "gzip"}


def text_answer(asked: Mapping[str, str], data: bytes, kind: str, keep: str = ASK_AGAIN) -> Response:
    """Return a text that stays the same while the daemon runs; 304 without it where the client has it.

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
        # A browser takes its headers for those of what it has, the policy that goes by the kind too.
        return Response(status_code=304, headers=headers, media_type=kind)
    if _takes_packed(asked):
        return Response(_packed(data), media_type=kind, headers=headers | PACKED)
    return Response(data, media_type=kind, headers=headers)


def passing_answer(asked: Mapping[str, str], data: bytes, kind: str) -> Response:
    """Return a text of the moment, which nobody keeps; for a worker thread, as it computes for long."""
    if _takes_packed(asked):
        return Response(gzip.compress(data, QUICKLY), media_type=kind, headers=PACKED)
    return Response(data, media_type=kind)


@cache
def digest(data: bytes) -> str:
    """Return 16 hexadecimal digits that tell a text from others."""
    return hashlib.sha256(data).hexdigest()[:16]


def _takes_packed(asked: Mapping[str, str]) -> bool:
    return "gzip" in asked.get("accept-encoding", "")


@cache
def _packed(data: bytes) -> bytes:
    return gzip.compress(data, mtime=0)
