"""One pointing's residual, and the journal of those of the last days.

What is judged is not the whole residual but what is left of it beside the joints: where the picture shows the
target, less where position, mast file and *measured* joint angles put it. A servo that stops a count short is
a matter of the servo, not of the calibration.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ConfigDict, TypeAdapter, with_config

from calib.files.mast_file import StoredRig
from drivers.interfaces import COARSE_COUNT_RAD
from mastctl.answers import MeasuredPointing
from mastctl.control.records import Operation
from mastctl.watch.journal import Journal

DISAGREE = "eyes_disagree"


@with_config(ConfigDict(extra="forbid", allow_inf_nan=False))
class Measured(MeasuredPointing):
    """A pointing of which a new picture was taken, as the journal has it."""


_MEASURED = TypeAdapter(Measured)


def measured_of(record: Any) -> Measured:
    """Return the pointing of a line of the journal. Raises ValueError for anything else."""
    return _MEASURED.validate_python(record)


def measured_by(operation: Operation, mast: StoredRig, time_s: float) -> Measured | None:
    """Return what a pointing that has ended measured; None if it was none, or measured nothing.

    One that failed because another camera did not confirm the measurement counts too: a bumped camera does
    that. Of two pointings at one target the first counts; the second starts from the first one's result.
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
        to_rad = [settled["true_pan_rad"], settled["true_tilt_rad"]]
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
                "from_rad": [rest["true_pan_rad"], rest["true_tilt_rad"]],
                "to_rad": to_rad,
                "position_m": seen["position_m"],
                "range_m": math.dist(seen["position_m"], view.C.tolist()),
                "residual_px": found["residual_px"],
                "off_px": [a - b for a, b in zip(found["pixel_px"], predicted, strict=True)],
                "match_sigma_px": found["sigma_px"],
                "count_rad": [counts.get(axis, COARSE_COUNT_RAD) for axis in ("pan", "tilt")],
            }
        )
    except (LookupError, TypeError, ValueError):  # it did not come so far, or could not measure a number
        return None


FILE = "pointings.jsonl"
MOST_BYTES = 4 << 20
"""At which the file is written anew with what still counts; some 6000 pointings."""


def pointing_journal(folder: Path) -> Journal[Measured]:
    """Return the journal of pointings in a state folder."""
    return Journal(folder / FILE, "pointings", dict, measured_of, most_bytes=MOST_BYTES)
