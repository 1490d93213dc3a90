"""Errors of the calib floor: one base, a subclass where a caller would act differently."""

from __future__ import annotations

from pathlib import Path


class CalibError(Exception):
    """Base of every error that calib raises on purpose; its text is one plain sentence."""


class BadFile(CalibError):
    """A file that cannot be used: which file, which place in it, and what would be right.

    ``place`` is the key, row or line inside the file (``cameras.navcam_left.A``, ``row 12``), empty for the
    whole file; ``reason`` the fault, with the value, and the expected one.
    """

    def __init__(self, path: str | Path, place: str, reason: str) -> None:
        self.path = Path(path)
        self.place = place
        self.reason = reason
        parts = (_one_line(text, limit) for text, limit in ((str(path), 300), (place, 120), (reason, 250)))
        super().__init__(": ".join(text for text in parts if text))


def _one_line(text: str, limit: int) -> str:
    """Return the text on one line of bounded length: a file's keys and values can hold anything."""
    shown = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text[: limit + 1])
    return shown if len(shown) <= limit else f"{shown[:limit]}..."


class CodedError(CalibError):
    """An error whose ``code`` names the cause for programs."""

    def __init__(self, code: str, message: str) -> None:
        self.code = code
        super().__init__(message)


class Unreachable(CodedError):
    """No joint angles bring the target onto the pixel.

    Codes: ``blind_cone``, ``too_near``, ``outside_limits``, ``bad_pixel``, ``bad_target``, ``parallel_axes``,
    ``bad_joints``.
    """


class NoStereoPoint(CodedError):
    """Two rays that do not meet in front of both cameras.

    Codes: ``parallel_rays``, ``behind_camera``, ``bad_pixel``, ``not_one_point``.
    """


class NoHandoff(CodedError):
    """A target that cannot be handed to another camera; codes: ``too_near``, ``too_far``, ``not_seen``."""


class NoCorrection(CodedError):
    """Hand-offs that give no correction of a rig.

    Codes: ``too_few``, ``one_sided``, ``inconsistent``, ``not_significant``, ``not_settled``.
    """
