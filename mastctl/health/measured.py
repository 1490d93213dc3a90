"""One pointing's residual as it is kept, and what an operation's record says of it.

What is judged is not the whole residual but what is left of it beside the joints: where the picture shows the
target, less where position, mast file and *measured* joint angles put it. A servo that stops a count short is
a matter of the servo, not of the calibration.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from mastctl.operations.records import Operation

COARSE_COUNT_RAD = math.tau / 4096
"""What a head that does not know its counts is taken to have: those of a 12-bit servo, the coarsest."""

Pair = tuple[float, float]
_PAIRS = ("from_rad", "to_rad", "residual_px", "off_px", "match_sigma_px", "count_rad")


@dataclass(frozen=True)
class Measured:
    """A pointing of which a new picture was taken.

    Attributes
    ----------
    time_s
        When, seconds of the wall clock since 1970 (UTC).
    operation, mast_digest
        Which one, and the mast file in use.
    source, partner, camera
        The pair that gave the position, the clicked eye first, and the camera that was aimed and looked.
    from_rad, to_rad
        (pan, tilt) as read when the pair looked, and at the new picture's mid-exposure.
    position_m, range_m
        The target in the rover frame, and its range from the aimed camera.
    residual_px, off_px, match_sigma_px
        (x, y) the residual; the part of it that measured joints do not explain; one sigma of the match.
    count_rad
        (pan, tilt) one count of each encoder.
    """

    time_s: float
    operation: str
    mast_digest: str
    source: str
    partner: str
    camera: str
    from_rad: Pair
    to_rad: Pair
    position_m: tuple[float, float, float]
    range_m: float
    residual_px: Pair
    off_px: Pair
    match_sigma_px: Pair
    count_rad: Pair

    def told(self) -> dict[str, Any]:
        """Return it as JSON."""
        return {
            key: list(value) if isinstance(value, tuple) else value for key, value in asdict(self).items()
        }


def measured_of(told: Mapping[str, Any]) -> Measured:
    """Return what `Measured.told` has told. Raises ValueError for anything else."""
    if set(told) != {field.name for field in fields(Measured)}:
        raise ValueError("its keys are not those of a pointing")
    values = dict(told)
    for key, size in (*((key, 2) for key in _PAIRS), ("position_m", 3)):
        values[key] = _numbers(values[key], key, size)
    for key in ("time_s", "range_m"):
        (values[key],) = _numbers([values[key]], key, 1)
    for key in ("operation", "mast_digest", "source", "partner", "camera"):
        if not isinstance(values[key], str):
            raise ValueError(f"{key} is no text")
    if min(values["match_sigma_px"]) <= 0.0 or min(values["count_rad"]) < 0.0:
        raise ValueError("a sigma is not above 0")
    return Measured(**values)


def measured_by(
    operation: Operation, mast_digest: str, stereo: Mapping[str, tuple[str, str]], time_s: float
) -> Measured | None:
    """Return what a finished pointing has measured; None if it was none, or measured nothing.

    Of two pointings at one target the first counts: the second starts from what the first has seen.
    """
    pixel = operation.request.get("pixel")
    result = operation.result
    if operation.state != "done" or not isinstance(pixel, Mapping) or not getattr(result, "pointings", ()):
        return None
    first = result.pointings[0]
    if first.residual_px is None or first.residual_sigma_px is None or first.predicted_px is None:
        return None
    source = str(pixel.get("camera"))
    partners = [a if source == b else b for a, b in stereo.values() if source in (a, b)]
    steps = {step.name: step.detail for step in reversed(operation.steps)}  # the first of each name
    rest, seen, solved = (steps.get(name, {}) for name in ("rest", "triangulate", "solve"))
    if not partners or "position_m" not in seen or "pan_rad" not in rest:
        return None
    counts = steps.get("settle", {}).get("counts", {})
    told = {
        "time_s": time_s,
        "operation": operation.id,
        "mast_digest": mast_digest,
        "source": source,
        "partner": partners[0],
        "camera": first.camera,
        "from_rad": (rest["pan_rad"], rest["tilt_rad"]),
        "to_rad": (first.measured_pan_rad, first.measured_tilt_rad),
        "position_m": tuple(seen["position_m"]),
        "range_m": solved.get("chosen", {}).get("range_m", seen["range_m"]),
        "residual_px": first.residual_px,
        "off_px": tuple(a - b for a, b in zip(first.target_px, first.predicted_px, strict=True)),
        "match_sigma_px": first.residual_sigma_px,
        "count_rad": tuple(
            counts.get(axis, {}).get("count_rad", COARSE_COUNT_RAD) for axis in ("pan", "tilt")
        ),
    }
    try:
        return measured_of(told)
    except ValueError:  # a number that could not be measured
        return None


def _numbers(values: object, key: str, size: int) -> tuple[float, ...]:
    """Pass so many finite numbers. Raises ValueError."""
    if not isinstance(values, list | tuple) or len(values) != size:
        raise ValueError(f"{key} is not {size} numbers")
    if not all(type(value) in (int, float) and math.isfinite(value) for value in values):
        raise ValueError(f"{key} is not {size} finite numbers")
    return tuple(float(value) for value in values)
