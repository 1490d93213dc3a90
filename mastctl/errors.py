"""Errors of the service: programs read ``code``, people read the message, one plain sentence.

A family says what its caller can do; the code names the subject. An error has a class of its own where
code catches it, or where it carries more than a code.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from calib.errors import CalibError
from drivers.errors import DriverError
from mastctl.as_json import as_json

log = logging.getLogger(__name__)

LONGEST_MESSAGE = 2000


class MastctlError(Exception):
    """Base of every error that the service raises on purpose."""

    code = "failed"


class _Family(MastctlError):
    """Errors that a caller treats alike; their ``code`` is a row of the table in docs/reference/http.md."""

    def __init__(self, code: str, message: str) -> None:
        self.code = code
        super().__init__(message)


class BadRequest(_Family):
    """The request makes no sense for this rig; a changed request may."""


class NotLetIn(_Family):
    """The client has shown no valid token."""


class NotAllowed(_Family):
    """The client's role does not permit the request; another role may."""


class NotKnown(_Family):
    """The request names something that does not exist here."""


class NoLonger(_Family):
    """The request names something that existed and is no longer kept."""


class NotNow(_Family):
    """The present state of the daemon does not allow the request; a later one may."""


class Unable(_Family):
    """The service cannot do it for any client; it may be requested again after ``retry_after_s`` seconds."""

    def __init__(self, code: str, message: str, retry_after_s: float | None = None) -> None:
        self.retry_after_s = retry_after_s
        super().__init__(code, message)


class Stopped(NotNow):
    """A stop was requested; the move was not sent or was cut short."""

    def __init__(self, message: str) -> None:
        super().__init__("stopped", message)


def one_line(text: object, longest: int) -> str:
    """Return a text from outside as one printable line, cut to ``longest`` signs; never raises.

    Control characters, and those that JSON cannot contain, become ``?``.
    """
    try:
        line = " ".join(str(text).split())
    except BaseException:  # an exception of a driver from outside may raise where it describes itself
        return ""
    return "".join(sign if sign.isprintable() else "?" for sign in line[:longest])


def error_body(error: BaseException) -> dict[str, Any]:
    """Return an error as programs read it: code, one plain sentence, more detail or null; never raises."""
    try:
        if isinstance(error, (MastctlError, DriverError, CalibError)):
            code = getattr(error, "code", None)
            detail = getattr(error, "detail", None)
            return {
                "code": code if isinstance(code, str) else MastctlError.code,
                "message": one_line(str(error), LONGEST_MESSAGE),
                "detail": as_json(detail) if isinstance(detail, Mapping) else None,
            }
    except Exception:  # of a driver from outside
        log.debug("an error that cannot be described", exc_info=True)
    return {
        "code": "internal",
        "message": f"the service met a defect of its own ({type(error).__name__}); its log says more",
        "detail": None,
    }
