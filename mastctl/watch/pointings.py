"""One pointing's residual as it is kept, and the file of those of the last days.

What is judged is not the whole residual but what is left of it beside the joints: where the picture shows the
target, less where position, mast file and *measured* joint angles put it. A servo that stops a count short is
a matter of the servo, not of the calibration.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from calib.errors import BadFile
from calib.files.atomic import replace_bytes
from calib.files.mast_file import StoredRig
from drivers.interfaces import COARSE_COUNT_RAD
from drivers.options import is_number
from mastctl.control.records import Operation
from mastctl.json_lines import append_line, read_lines

log = logging.getLogger(__name__)

DISAGREE = "eyes_disagree"

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
    confirmed
        Whether the other eyes confirmed what the aimed camera sees.
    source, partner, camera
        The pair that gave the position, the clicked eye first, and the camera that was aimed and looked.
    from_rad, to_rad
        True (pan, tilt) when the pair looked, and when the new picture was taken.
    position_m, range_m
        The target in the rover frame, and its range from the aimed camera.
    residual_px, off_px, match_sigma_px
        (x, y) the residual; the part of it that measured joints do not explain; one sigma of the match.
    count_rad
        (pan, tilt) one count of each encoder.
    """

    time_s: float
    operation: str
    confirmed: bool
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
    if not isinstance(values["confirmed"], bool):
        raise ValueError("confirmed is neither true nor false")
    if min(values["match_sigma_px"]) <= 0.0 or min(values["count_rad"]) < 0.0:
        raise ValueError("a sigma is not above 0")
    return Measured(**values)


def measured_by(operation: Operation, mast: StoredRig, time_s: float) -> Measured | None:
    """Return what a pointing that has ended measured; None if it was none, or measured nothing.

    One that failed because another eye did not confirm what it measured counts too: that is what a bumped
    camera looks like. Of two pointings at one target the first counts; the second starts from what the first
    has seen.
    """
    pixel = operation.request.get("pixel")
    confirmed = operation.state == "done"
    if not isinstance(pixel, Mapping) or not (confirmed or (operation.error or {}).get("code") == DISAGREE):
        return None
    source, rig = str(pixel.get("camera")), mast.rig
    partners = [a if source == b else b for a, b in rig.stereo.values() if source in (a, b)]
    steps = {step.name: step.detail for step in reversed(operation.steps)}  # the first of each name
    try:
        rest, seen, settled, found = (steps[name] for name in ("rest", "triangulate", "settle", "measure"))
        found = steps.get("repeat", found)
        to_rad = settled["true_pan_rad"], settled["true_tilt_rad"]
        view = rig.camera_in_rover(found["camera"], *to_rad)
        predicted = view.project(seen["position_m"])[0].tolist()
        counts = settled.get("count_rad", {})
        return measured_of(
            {
                "time_s": time_s,
                "operation": operation.id,
                "confirmed": confirmed,
                "mast_digest": mast.digest,
                "source": source,
                "partner": partners[0],
                "camera": found["camera"],
                "from_rad": (rest["true_pan_rad"], rest["true_tilt_rad"]),
                "to_rad": to_rad,
                "position_m": seen["position_m"],
                "range_m": math.dist(seen["position_m"], view.C.tolist()),
                "residual_px": found["residual_px"],
                "off_px": tuple(a - b for a, b in zip(found["pixel_px"], predicted, strict=True)),
                "match_sigma_px": found["sigma_px"],
                "count_rad": tuple(counts.get(axis, COARSE_COUNT_RAD) for axis in ("pan", "tilt")),
            }
        )
    except (LookupError, TypeError, ValueError):  # it did not come so far, or could not measure a number
        return None


def _numbers(values: object, key: str, size: int) -> tuple[float, ...]:
    """Pass so many finite numbers. Raises ValueError."""
    if not isinstance(values, list | tuple) or len(values) != size:
        raise ValueError(f"{key} is not {size} numbers")
    if not all(is_number(value) for value in values):
        raise ValueError(f"{key} is not {size} finite numbers")
    return tuple(float(value) for value in values)


FILE = "pointings.jsonl"
MOST_BYTES = 4 << 20
"""At which the file is written anew with what still counts; some 6000 pointings."""


class Journal:
    """A file of pointings; used by one thread.

    Parameters
    ----------
    path
        The file; its folder must be there.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> list[Measured]:
        """Return what the file holds, in its order; lines that are none are passed over, and told.

        Raises
        ------
        BadFile
            If the file system refuses.
        """
        try:
            lines = read_lines(self.path, 2 * MOST_BYTES)
        except OSError as error:
            raise BadFile(self.path, "", f"cannot be read: {error.strerror or error}") from None
        found, strange = [], 0
        for line in lines:
            try:
                found.append(measured_of(json.loads(line)))
            except (ValueError, TypeError, RecursionError):
                strange += 1
        if strange:
            log.warning(
                "%s: %d of %d lines are no pointings and do not count", self.path, strange, len(lines)
            )
        return found

    def add(self, one: Measured, counting: Sequence[Measured]) -> None:
        """Append a pointing; where the file is full it is written anew with ``counting``, which has it too.

        Raises
        ------
        BadFile
            If the file system refuses; what was there is still there.
        """
        try:
            if not append_line(self.path, _line(one), MOST_BYTES):
                replace_bytes(self.path, b"".join(map(_line, counting)))
        except OSError as error:
            raise BadFile(self.path, "", f"cannot be written: {error.strerror or error}") from None


def _line(one: Measured) -> bytes:
    return (json.dumps(one.told(), allow_nan=False) + "\n").encode()
