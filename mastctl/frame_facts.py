"""The facts of a picture: the one list of what stands beside it, in the daemon, in headers, in the client."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any


@dataclass(frozen=True, eq=False)
class FrameFacts:
    """What a picture is worth little without.

    Attributes
    ----------
    frame_id, camera, sequence
        Its name; the camera's name in the mast file; the camera's own count.
    mid_exposure_s, exposure_s
        Middle of the exposure, seconds of CLOCK_MONOTONIC, and its length, seconds.
    pan_rad, tilt_rad
        Joint angles at mid-exposure, radians, interpolated from the measured ones around it: as read.
    moving
        Whether the head moved, or was told to, at any time of the exposure.
    mast_digest
        SHA-256 (hex) of the mast file in use.
    true_pan_rad, true_tilt_rad
        Where the axes truly stood by its ``joints``: what a camera's place follows from.
    pan_approach, tilt_approach
        From which side each axis had come: 1 from smaller readings, -1 from larger, 0 not known, between
        them where it had not gone through all of its play.
    settings
        Exposure time, gain, ... that it was taken with, by the names of `drivers.interfaces.SETTINGS`; None
        for what is not known of this picture, as while it was being changed.
    """

    frame_id: str
    camera: str
    sequence: int
    mid_exposure_s: float
    exposure_s: float
    pan_rad: float
    tilt_rad: float
    moving: bool
    mast_digest: str
    true_pan_rad: float = field(kw_only=True)
    true_tilt_rad: float = field(kw_only=True)
    pan_approach: float = field(kw_only=True, default=0.0)
    tilt_approach: float = field(kw_only=True, default=0.0)
    settings: Mapping[str, float | None] = field(kw_only=True, default_factory=dict)

    @property
    def true_rad(self) -> tuple[float, float]:
        """True (pan, tilt)."""
        return self.true_pan_rad, self.true_tilt_rad


def headers_of(facts: FrameFacts) -> dict[str, str]:
    """Return the facts as headers; numbers in shortest round-trip form."""
    told = {header: getattr(facts, name) for name, header in _HEADERS.items()}
    return {header: value if isinstance(value, str) else json.dumps(value) for header, value in told.items()}


def facts_in(headers: Mapping[str, str]) -> dict[str, Any]:
    """Return the facts that stand in headers, by name.

    Raises
    ------
    KeyError, ValueError
        If one is missing, or is no value of its kind.
    """
    return {one.name: _READ[str(one.type)](headers[_HEADERS[one.name]]) for one in fields(FrameFacts)}


def described_headers() -> dict[str, Any]:
    """Return how OpenAPI describes these headers."""
    kinds = {"str": "string", "int": "integer", "float": "number", "bool": "boolean"}
    return {
        _HEADERS[one.name]: {"required": True, "schema": {"type": kinds.get(str(one.type), "string")}}
        for one in fields(FrameFacts)
    }


def _settings_in(text: str) -> dict[str, float | None]:
    """What a picture was taken with, from JSON. Raises ValueError."""
    told = json.loads(text)
    if not isinstance(told, dict) or not all(value is None or _is_number(value) for value in told.values()):
        raise ValueError("an object of numbers is expected")
    return {name: None if value is None else float(value) for name, value in told.items()}


def _is_number(value: object) -> bool:
    """Whether it is a number within the range of floats; `drivers.options` has the same and loads NumPy."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return abs(value) <= sys.float_info.max


_HEADERS = {one.name: "Mastctl-" + one.name.replace("_", "-").title() for one in fields(FrameFacts)}
_READ: Mapping[str, Callable[[str], Any]] = {
    "str": str,
    "int": int,
    "float": float,
    "bool": {"true": True, "false": False}.__getitem__,
    "Mapping[str, float | None]": _settings_in,
}
