"""Errors of the service floor: one base; ``code`` is what programs read, the text is one plain sentence."""

from __future__ import annotations


class MastctlError(Exception):
    """Base of every error that the service raises on purpose."""

    code = "failed"


class FrameGone(MastctlError):
    """A frame was named that this service cannot measure in: ``code`` says why.

    Codes: ``frame_unknown`` (never taken here), ``frame_too_old``, ``other_mast_file``.
    """

    def __init__(self, code: str, message: str) -> None:
        self.code = code
        super().__init__(message)


class Stopped(MastctlError):
    """A stop was asked for; the move was not sent or was cut short."""

    code = "stopped"
