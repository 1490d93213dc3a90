"""The facts of an image: their one list, for the daemon, for headers and for the client."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar


@dataclass(frozen=True, eq=False)
class FrameFacts:
    """What an image is worth little without; ``sequence`` is the camera's own count.

    ``mid_exposure_s`` is of CLOCK_MONOTONIC. The joint angles are those at mid-exposure, interpolated from
    the measured ones around it: as read, and true by the ``joints`` of the mast file, whose SHA-256 (hex) is
    ``mast_digest``. ``moving``: whether the head moved, or was sent, at any time of the exposure.

    ``pan_approach`` and ``tilt_approach`` say from which side each axis had come: 1 from smaller readings, -1
    from larger, 0 not known, between them where it had not gone through all of its play. ``settings`` has
    exposure time, gain, ... by the names of `drivers.interfaces.SETTINGS`; None for what is not known of this
    picture, as while it was being changed.
    """

    __pydantic_config__: ClassVar = {"strict": False}  # in files it is a mapping
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
    values = {header: getattr(facts, name) for name, header in _HEADERS.items()}
    return {name: value if isinstance(value, str) else json.dumps(value) for name, value in values.items()}


def facts_in(headers: Mapping[str, str]) -> dict[str, Any]:
    """Return the facts in headers, by name. Raises KeyError, ValueError if one is missing or wrong."""
    return {one.name: _READ[str(one.type)](headers[_HEADERS[one.name]]) for one in fields(FrameFacts)}


def described_headers() -> dict[str, Any]:
    """Return how OpenAPI describes these headers."""
    kinds = {"str": "string", "int": "integer", "float": "number", "bool": "boolean"}
    return {
        _HEADERS[one.name]: {"required": True, "schema": {"type": kinds.get(str(one.type), "string")}}
        for one in fields(FrameFacts)
    }


_HEADERS = {one.name: "Mastctl-" + one.name.replace("_", "-").title() for one in fields(FrameFacts)}
_READ: Mapping[str, Callable[[str], Any]] = {
    "str": str,
    "int": int,
    "float": float,
    "bool": {"true": True, "false": False}.__getitem__,
    "Mapping[str, float | None]": json.loads,
}
