"""Refusals before the API, and the headers that every answer carries."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from starlette.responses import JSONResponse

HEADERS: Mapping[str, str] = {
    "cache-control": "no-store",
    "x-content-type-options": "nosniff",
    "cross-origin-resource-policy": "same-origin",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
}
NO_PAGE = "default-src 'none'; frame-ancestors 'none'"
"""The Content-Security-Policy of what is no page: opened by itself it may do nothing."""
PAGE = (
    "default-src 'self'; img-src 'self' blob: data:; object-src 'none'; base-uri 'none'; "
    "form-action 'self'; frame-ancestors 'none'"
)
"""The Content-Security-Policy of a page: its own files only, no script inside it, in nobody's frame."""

Headers = list[tuple[bytes, bytes]]


class GuardError(Exception):
    """A request that does not get as far as the API."""

    def __init__(
        self, status: int, code: str, message: str, headers: Mapping[str, str] | None = None
    ) -> None:
        self.status = status
        self.code = code
        self.headers = dict(headers or {})
        super().__init__(message)


def error_response(
    status: int, code: str, message: str, detail: Any = None, headers: Mapping[str, str] | None = None
) -> JSONResponse:
    """Return an error in the one form of docs/reference/http.md."""
    body = {"error": {"code": code, "message": message, "detail": detail}}
    told = {**HEADERS, "content-security-policy": NO_PAGE, **(headers or {})}
    return JSONResponse(body, status_code=status, headers=told)


def marked(headers: Iterable[tuple[bytes, bytes]]) -> Headers:
    """Return an answer's headers with those of every answer that it does not have already."""
    told = list(headers)
    had = {name.lower() for name, _ in told}
    kind = next((value for name, value in told if name.lower() == b"content-type"), b"")
    policy = PAGE if kind.startswith(b"text/html") else NO_PAGE
    wanted = {**HEADERS, "content-security-policy": policy}
    return told + [(n.encode(), v.encode()) for n, v in wanted.items() if n.encode() not in had]
