"""Errors of the service floor: ``code`` is what programs read, the text is one plain sentence.

A family says what its caller can do; the word says what it is about. A class of its own is for what
somebody catches, or what carries more than a word.
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
    """Errors that a caller meets in one way, told apart by their code.

    Parameters
    ----------
    code
        What programs read; a row of the table in docs/reference/http.md.
    message
        One plain sentence.
    """

    def __init__(self, code: str, message: str) -> None:
        self.code = code
        super().__init__(message)


class BadRequest(_Family):
    """What was asked makes no sense for this rig: asked otherwise it may."""


class NotLetIn(_Family):
    """Who asks has not shown who it is."""


class TooMany(_Family):
    """Somebody asks too often; it may ask again after ``retry_after_s`` seconds."""

    def __init__(self, code: str, message: str, retry_after_s: float = 1.0) -> None:
        self.retry_after_s = retry_after_s
        super().__init__(code, message)


class NotAllowed(_Family):
    """Who asks may not: somebody else may."""


class NotKnown(_Family):
    """Something was named that is not here."""


class NoLonger(_Family):
    """Something was named that was here and is not kept."""


class NotNow(_Family):
    """What was asked does not fit the moment: what runs, moves or is in use stands against it."""


class Unable(_Family):
    """The service cannot do it, whoever asks; it may be asked again after ``retry_after_s`` seconds."""

    def __init__(self, code: str, message: str, retry_after_s: float | None = None) -> None:
        self.retry_after_s = retry_after_s
        super().__init__(code, message)


class Stopped(NotNow):
    """A stop was asked for; the move was not sent or was cut short."""

    def __init__(self, message: str) -> None:
        super().__init__("stopped", message)


def one_line(text: object, longest: int) -> str:
    """Return what was said outside as one printable line, cut to ``longest`` signs; never raises.

    What a terminal obeys or JSON cannot hold becomes ``?``. What has no words is an empty line.
    """
    try:
        words = " ".join(str(text).split())
    except BaseException:  # an exception of a driver from outside may raise where it is to say what it is
        return ""
    return "".join(sign if sign.isprintable() else "?" for sign in words[:longest])


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
    except Exception:  # a driver from outside raised what cannot even be put into words
        log.debug("an error without words", exc_info=True)
    return {
        "code": "internal",
        "message": f"the service met a defect of its own ({type(error).__name__}); its log says more",
        "detail": None,
    }
